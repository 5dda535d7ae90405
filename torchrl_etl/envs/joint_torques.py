"""Joint torques of a body's muscles, computed from the MuJoCo model."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etl.envs.muscles import muscle_state, sends_sigmoid

__all__ = ["JointTorques", "active_torques", "excitation", "joint_torques"]


class JointTorques(NamedTuple):
    """Names of J joints, and the torque of each fully active muscle on them [J, n], N·m (or N)."""

    joints: tuple[str, ...]
    matrix: np.ndarray


def joint_torques(
    env: EnvBase, *, num_postures: int = 32, spread: float = 0.25, seed: int = 0
) -> JointTorques:
    """Torque of each fully active muscle on each joint: moment arm times peak force.

    Torques are averaged over the current posture and random postures near it, at zero velocity.
    These move every joint by up to half of ``spread`` times its range to either side. Only active
    forces count, not passive ones. If an equality couples a joint to another one (the sliding
    parts of a knee), its torque is added to that joint's, scaled by the ratio of their motions.
    Joints that no muscle spans are left out.

    Args:
        env (EnvBase): an environment with a MuJoCo model, actuated only by muscles.

    Keyword Args:
        num_postures (int): total number of postures. Default: 32.
        spread (float): share of each joint's range that the postures cover. Default: 0.25.
        seed (int): seed of the postures. Default: 0.

    Returns:
        JointTorques: rows in the model's joint order, columns in action order.

    Raises:
        ValueError: if there is no MuJoCo model, or if not all of its actuators are muscles.

    Examples:
        >>> from torchrl_etl.envs import joint_torques, make_env
        >>> torques = joint_torques(make_env("myoHandKeyTurn", seed=0), num_postures=2)
        >>> torques.matrix.shape  # 23 joints, 39 muscles
        (23, 39)
    """
    model, now = muscle_state(env, "The torque of each muscle, as for synergies=body,")
    import mujoco  # installed, since the model exists

    data, generator = mujoco.MjData(model), np.random.default_rng(seed)
    simple = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    limited = np.flatnonzero(simple & model.jnt_limited.astype(bool))
    span = spread * np.ptp(model.jnt_range[limited], axis=1)
    total = np.zeros((model.njnt, model.nu))
    for posture in range(num_postures):
        data.qpos[:] = now.qpos
        if posture:
            places = model.jnt_qposadr[limited]
            moved = data.qpos[places] + span * generator.uniform(-0.5, 0.5, len(limited))
            data.qpos[places] = moved.clip(*model.jnt_range[limited].T)
        total[simple] += _tied(model, data) @ active_torques(model, data, simple)
    mean = total / num_postures
    moved = np.abs(mean).max(1) > 1e-6 * np.abs(mean).max()
    names = tuple(model.joint(int(joint)).name for joint in np.flatnonzero(moved))
    return JointTorques(names, mean[moved])


def excitation(env: EnvBase, action: Tensor) -> Tensor:
    """Excitations in [0, 1] of actions [*, n]: MyoSuite's sigmoid of them, or the actions.

    Under a constant excitation, the activation of a muscle converges to it.

    Raises:
        ValueError: if the environment does not tell which of the two applies.

    Examples:
        >>> import torch
        >>> from torchrl_etl.envs import excitation, make_env
        >>> excitation(make_env("myoHandKeyTurn"), torch.tensor([-1.0, 0.5])).tolist()
        [0.0005..., 0.5]
    """
    base = getattr(env, "base_env", env)  # with a SynergyAction, actions are synergies
    bounds = base.full_action_spec_unbatched["action"].space
    if sends_sigmoid(env, bounds.low, bounds.high):
        return (5.0 * (action - 0.5)).sigmoid()
    return action


def active_torques(model: Any, data: Any, joints: np.ndarray) -> np.ndarray:
    """Active torque of each muscle on hinge or slide joints [J, n] in the current posture."""
    import mujoco

    torques = []
    data.qvel[:] = 0.0
    for activation in (np.zeros(model.na), *np.eye(model.na)):
        data.act[model.actuator_actadr] = activation
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_actuator[model.jnt_dofadr[joints]].copy())
    return (np.array(torques[1:]) - torques[0]).T


def _tied(model: Any, data: Any) -> np.ndarray:
    """Motion of each hinge or slide (column) per motion of each free one (row) [J, J].

    Moves the coupled joints of ``data`` to satisfy their equalities.
    """
    import mujoco

    moves = np.eye(model.njnt)
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        tied, free = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if not data.eq_active[equality]:
            continue
        polynomial = np.polynomial.Polynomial(model.eq_data[equality, :5])
        moves[tied, tied] = 0.0
        at, start = model.jnt_qposadr, model.qpos0
        offset = 0.0 if free < 0 else data.qpos[at[free]] - start[at[free]]
        data.qpos[at[tied]] = start[at[tied]] + polynomial(offset)
        if free >= 0:
            moves[free, tied] = polynomial.deriv()(offset)
    simple = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    return moves[np.ix_(simple, simple)]
