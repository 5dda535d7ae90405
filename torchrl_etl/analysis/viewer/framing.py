"""What of a scene is the body's, and from where all of it is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

__all__ = ["SHOWN_GROUPS", "middle_and_size", "moving_bodies", "planes", "scenery", "seen"]

SHOWN_GROUPS = 3
"""MuJoCo draws groups 0 to 2 of geoms and sites, unless it is told otherwise."""


def planes(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms [ngeom] are floors or other planes."""
    import mujoco  # there, since its model is

    return model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)


def scenery(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms [ngeom] stand there for show alone, such as the walls of a room."""
    touched = (model.geom_contype | model.geom_conaffinity) != 0
    return (model.geom_bodyid == 0) & ~touched & ~planes(model)


def seen(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms [ngeom] the viewer draws: those MuJoCo would, and the bones under a skin.

    The page cannot draw a skin, and a model that has one hides its meshes in a group of their own.
    """
    import mujoco

    bones = (model.nskin > 0) & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))
    return (model.geom_group < SHOWN_GROUPS) | bones


def moving_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Bodies that can move against the world, or are all there is."""
    moving = np.flatnonzero(model.body_weldid != 0)
    return moving if len(moving) else np.arange(model.nbody)


def middle_and_size(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, float]:
    """Middle [3] of the moving bodies in the world, and how far apart they are, 0.1 or more.

    What is drawn of a body counts, not its origin alone: a torso of one piece has its head far off.
    So do tendons, which reach to bones that do not move.
    """
    from torchrl_etl.analysis.viewer.muscles import paths  # there, since it needs MuJoCo

    bodies, path = moving_bodies(model), paths(model, data)
    places = [data.xpos[bodies], _corners(model, data, bodies), path.start, path.end]
    places = np.concatenate(places)
    low, high = places.min(0), places.max(0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.1)


def _corners(model: mujoco.MjModel, data: mujoco.MjData, bodies: np.ndarray) -> np.ndarray:
    """Corners [8 G, 3] of the boxes around what is drawn of bodies."""
    geoms = np.isin(model.geom_bodyid, bodies) & seen(model)
    middle, half = np.split(model.geom_aabb[geoms], 2, axis=1)
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
    boxes = middle[:, None] + signs * half[:, None]
    turned = boxes @ data.geom_xmat[geoms].reshape(-1, 3, 3).swapaxes(1, 2)
    return (data.geom_xpos[geoms, None] + turned).reshape(-1, 3)
