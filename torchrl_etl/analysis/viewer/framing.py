"""What of a scene is the body's, and from where all of it is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

__all__ = ["middle_and_size", "moving_bodies", "planes", "scenery"]


def planes(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms [ngeom] are floors or other planes."""
    import mujoco  # there, since its model is

    return model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)


def scenery(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms [ngeom] stand there for show alone, such as the walls of a room."""
    touched = (model.geom_contype | model.geom_conaffinity) != 0
    return (model.geom_bodyid == 0) & ~touched & ~planes(model)


def moving_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Bodies that can move against the world, or are all there is."""
    moving = np.flatnonzero(model.body_weldid != 0)
    return moving if len(moving) else np.arange(model.nbody)


def middle_and_size(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, float]:
    """Middle [3] of the moving bodies in the world, and how far apart they are, 0.1 or more."""
    places = data.xpos[moving_bodies(model)]
    low, high = places.min(0), places.max(0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.1)
