"""Visible geoms and extent of a body, for placing the camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

__all__ = ["SHOWN_GROUPS", "middle_and_size", "moving_bodies", "planes", "scenery", "seen"]

SHOWN_GROUPS = 3
"""By default, MuJoCo draws groups 0 to 2 of geoms and sites."""


def planes(model: mujoco.MjModel) -> np.ndarray:
    """Mask [ngeom] of geoms that are planes, such as floors."""
    import mujoco  # installed, since the model exists

    return model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)


def scenery(model: mujoco.MjModel) -> np.ndarray:
    """Mask [ngeom] of purely visual geoms of the world, such as the walls of a room."""
    touched = (model.geom_contype | model.geom_conaffinity) != 0
    return (model.geom_bodyid == 0) & ~touched & ~planes(model)


def seen(model: mujoco.MjModel) -> np.ndarray:
    """Mask [ngeom] of geoms to draw: those drawn by MuJoCo, and the bones under a skin.

    The viewer cannot draw skins, and a model with a skin hides its meshes in a separate group.
    """
    import mujoco

    bones = (model.nskin > 0) & (model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))
    return (model.geom_group < SHOWN_GROUPS) | bones


def moving_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Bodies that can move relative to the world, or all bodies if none can."""
    moving = np.flatnonzero(model.body_weldid != 0)
    return moving if len(moving) else np.arange(model.nbody)


def middle_and_size(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, float]:
    """Center [3] of the bounding box of the moving bodies, and its diagonal, at least 0.1.

    The box includes drawn geoms, which may reach far from a body's origin, and tendons, which
    reach to bones that do not move.
    """
    from torchrl_etl.analysis.viewer.muscles import paths  # imported here, since it needs MuJoCo

    bodies, path = moving_bodies(model), paths(model, data)
    corners = _corners(model, data, bodies)
    places = np.concatenate([data.xpos[bodies], corners, path.start, path.end])
    low, high = places.min(0), places.max(0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.1)


def _corners(model: mujoco.MjModel, data: mujoco.MjData, bodies: np.ndarray) -> np.ndarray:
    """Corners [8 G, 3] of the bounding boxes of the bodies' drawn geoms."""
    geoms = np.isin(model.geom_bodyid, bodies) & seen(model)
    middle, half = np.split(model.geom_aabb[geoms], 2, axis=1)
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
    boxes = middle[:, None] + signs * half[:, None]
    turned = boxes @ data.geom_xmat[geoms].reshape(-1, 3, 3).swapaxes(1, 2)
    return (data.geom_xpos[geoms, None] + turned).reshape(-1, 3)
