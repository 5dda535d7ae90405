"""Joints of the body and free joints of a MuJoCo model, and holding joints in place."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from torchrl.envs import EnvBase

from torchrl_etl.envs.simulator import mujoco_state

if TYPE_CHECKING:
    import mujoco

__all__ = ["HeldJoints", "body_joints", "has_free_root", "root_joints"]


def body_joints(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Mask [njnt] of the joints in kinematic trees that an actuator acts on.

    Other joints belong to objects, whether these float, slide or turn. The mask includes joints
    of the body that no actuator moves, such as the hinge of cartpole's pole.

    Args:
        model, data: from :func:`~torchrl_etl.envs.mujoco_state`, after a reset.

    Examples:
        >>> from torchrl_etl.envs import make_env, mujoco_state
        >>> env = make_env("cartpole-balance")
        >>> _ = env.reset()
        >>> body_joints(*mujoco_state(env))
        array([ True,  True])
    """
    import mujoco  # installed, since the model exists

    moments = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(
        moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    )
    trees = np.unique(model.dof_treeid[moments.any(0)])
    return np.isin(model.dof_treeid[model.jnt_dofadr], trees)


def root_joints(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Mask [njnt] of the body's free joints; arguments as for :func:`body_joints`."""
    import mujoco  # installed, since the model exists

    return body_joints(model, data) & (model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))


def has_free_root(env: EnvBase) -> bool:
    """Whether the actuated body has a free root joint, as legs do and hands do not.

    Args:
        env (EnvBase): from :func:`~torchrl_etl.envs.make_env`; this resets it. An environment
            without MuJoCo has no free root.

    Examples:
        >>> from torchrl_etl.envs import make_env
        >>> has_free_root(make_env("humanoid-stand")), has_free_root(make_env("overactuated"))
        (True, False)
    """
    try:
        model, data = mujoco_state(env)
    except ValueError:
        return False
    env.reset()
    return bool(root_joints(model, data).any())


class HeldJoints:
    """Joints that can be restored to a remembered pose, with zero velocity.

    Args:
        model, data: from :func:`~torchrl_etl.envs.mujoco_state`, in the first pose to remember.
        joints (np.ndarray): mask [njnt] of the joints to hold.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, joints: np.ndarray) -> None:
        self._data = data
        self._positions = _entries(joints, model.jnt_qposadr, model.nq)
        self._velocities = _entries(joints, model.jnt_dofadr, model.nv)
        self.remember()

    def remember(self) -> None:
        self._pose = self._data.qpos[self._positions].copy()

    def restore(self) -> None:
        self._data.qpos[self._positions] = self._pose
        self._data.qvel[self._velocities] = 0.0


def _entries(joints: np.ndarray, first: np.ndarray, size: int) -> np.ndarray:
    """Mask [size] over qpos or qvel of these joints, whose entries begin at ``first``."""
    return np.repeat(joints, np.diff(first, append=size))
