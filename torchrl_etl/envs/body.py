"""Which joints of a simulation are the body's own, and whether that body stands free."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from torchrl.envs import EnvBase

from torchrl_etl.envs.simulator import mujoco_state

if TYPE_CHECKING:
    import mujoco

__all__ = ["body_joints", "has_free_root"]


def body_joints(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Which joints [njnt] are in a kinematic tree that an actuator acts on.

    The others are those of objects, whether they float, slide or turn. A joint of the body that no
    actuator moves, such as the pole of a cart, is the body's all the same.

    Args:
        model, data: of :func:`~torchrl_etl.envs.mujoco_state`, after a reset.

    Examples:
        >>> from torchrl_etl.envs import make_env, mujoco_state
        >>> env = make_env("cartpole-balance")
        >>> _ = env.reset()
        >>> body_joints(*mujoco_state(env))
        array([ True,  True])
    """
    import mujoco  # there, since its model is

    moments = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(
        moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    )
    trees = np.unique(model.dof_treeid[moments.any(0)])
    return np.isin(model.dof_treeid[model.jnt_dofadr], trees)


def has_free_root(env: EnvBase) -> bool:
    """Whether the body that actuators move floats freely, as legs do and a hand does not.

    Args:
        env (EnvBase): of :func:`~torchrl_etl.envs.make_env`; it is reset. An environment without
            MuJoCo has no free root.

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
    import mujoco

    free = model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
    return bool((free & body_joints(model, data)).any())
