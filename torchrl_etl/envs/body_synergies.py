"""Synergies from a body's moment arms: each drives one joint, or a combination of joints."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etl.checks import check_integer, check_real
from torchrl_etl.envs.joint_torques import excitation, joint_torques
from torchrl_etl.modules import SynergyDecoder

__all__ = ["body_decoder", "body_synergies", "muscle_changes"]

# Relative cutoff for singular values. Combinations of joints that muscles can barely turn would
# take all of their strength.
WEAKEST = 0.1


def body_synergies(
    env: EnvBase, num_synergies: int | None = None, *, rest: float = 0.25
) -> SynergyDecoder:
    """A decoder from joint torques to actions, computed from moment arms without learning.

    With all coefficients at 0, every muscle has the activation ``rest``. Setting one coefficient
    to 1 adds a torque at its joint: the strongest agonist comes to about full activation, its
    antagonists to none. See :func:`muscle_changes` and :meth:`SynergyDecoder.from_directions`.

    Args:
        env (EnvBase): a body actuated only by muscles, after a reset.
        num_synergies (int, optional): d, at most the number J of joints that muscles turn. With
            fewer, each is a combination of the joints that muscles turn most. Default: J.

    Keyword Args:
        rest (float): activation at zero coefficients, in (0, 1). Default: 0.25.

    Raises:
        ValueError: if not all actuators are muscles, d is not in 1 to J, or ``rest`` is outside of
            (0, 1).

    Examples:
        >>> from torchrl_etl.envs import body_synergies, make_env
        >>> env = make_env("myoHandKeyTurn", seed=0)
        >>> _ = env.reset()
        >>> body_synergies(env).num_synergies  # its joints
        23
    """
    changes = muscle_changes(joint_torques(env).matrix, num_synergies)
    return body_decoder(env, changes, rest=rest)


def muscle_changes(torques: np.ndarray, num_synergies: int | None = None) -> np.ndarray:
    """Changes of activation [d, n] that each turn one joint, or one combination of joints.

    Equation: the rows of pinv(M)ᵀ, where M is ``torques`` with rows of unit length, without
    singular values below a tenth of the largest. For d < J, M's first d left singular vectors
    combine these rows.

    Args:
        torques (array): torque of each fully active muscle on each joint [J, n].
        num_synergies (int, optional): d, at most J; with all J, synergy i turns joint i alone.

    Returns:
        array: changes [d, n], whose largest magnitude in each row is 1.

    Raises:
        ValueError: if d is not in 1 to J.

    Examples:
        >>> import numpy as np
        >>> from torchrl_etl.envs import muscle_changes
        >>> muscle_changes(np.array([[2.0, -2.0]]))  # two opponents at one joint
        array([[ 1., -1.]])
    """
    joints = len(torques)
    if num_synergies is not None:
        check_integer(1, num_synergies=num_synergies)
        if num_synergies > joints:
            raise ValueError(
                f"num_synergies is {num_synergies} but muscles turn only {joints} joints; pass 1 "
                f"to {joints}, or leave it out for one per joint."
            )
    unit = torques / np.linalg.norm(torques, axis=1, keepdims=True)
    inverse = np.linalg.pinv(unit, rcond=WEAKEST).T
    if num_synergies is not None and num_synergies < joints:
        inverse = np.linalg.svd(unit)[0][:, :num_synergies].T @ inverse
    return inverse / np.abs(inverse).max(1, keepdims=True)


def body_decoder(env: EnvBase, changes: np.ndarray, *, rest: float = 0.25) -> SynergyDecoder:
    """A decoder into actions whose excitations differ from ``rest`` by ``changes`` [d, n]."""
    check_real("(0, 1)", rest=rest)
    bounds = env.full_action_spec_unbatched["action"].space
    center, slope = _action_of(env, rest, bounds.low, bounds.high)
    directions = torch.from_numpy(changes).to(center) / slope
    return SynergyDecoder.from_directions(center, directions, low=bounds.low, high=bounds.high)


def _action_of(env: EnvBase, rest: float, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The action [n] whose excitation is ``rest``, and the slope of excitation there [n]."""
    low, high = low.clone().double(), high.clone().double()
    if not ((excitation(env, low) < rest) & (rest < excitation(env, high))).all():
        raise ValueError(
            f"rest is {rest}; it must be an excitation that actions inside the bounds reach."
        )
    for _ in range(60):  # bisection: excitation is increasing
        middle = (low + high) / 2
        below = excitation(env, middle) < rest
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    center = ((low + high) / 2).requires_grad_()
    (slope,) = torch.autograd.grad(excitation(env, center).sum(), center)
    return center.detach().float(), slope.float()
