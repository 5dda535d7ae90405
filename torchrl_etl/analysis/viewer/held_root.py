"""A body that would fall over is held where it stands, so that its synergies can be looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from torchrl_etl.envs import body_joints

if TYPE_CHECKING:
    import mujoco

__all__ = ["HeldRoot"]


class HeldRoot:
    """Puts the free joints of a body back to where they were remembered.

    Args:
        model, data: of :func:`~torchrl_etl.envs.mujoco_state`, after a reset.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        import mujoco  # there, since its model is

        self._model, self._data, self._forward = model, data, mujoco.mj_forward
        free = model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
        joints = np.flatnonzero(free & body_joints(model, data))
        self._positions = np.concatenate([model.jnt_qposadr[j] + np.arange(7) for j in joints])
        self._velocities = np.concatenate([model.jnt_dofadr[j] + np.arange(6) for j in joints])
        self.remember()

    def remember(self) -> None:
        self._place = self._data.qpos[self._positions].copy()

    def restore(self) -> None:
        self._data.qpos[self._positions] = self._place
        self._data.qvel[self._velocities] = 0.0
        self._forward(self._model, self._data)
