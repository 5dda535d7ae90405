"""Synergies of a body's moment arms: each is the torque of one joint, or of several together."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etl.checks import check_integer, check_real
from torchrl_etl.envs.joint_torques import excitation, joint_torques
from torchrl_etl.modules import SynergyDecoder

__all__ = ["body_decoder", "body_synergies", "muscle_changes"]

# Combinations of joints that muscles turn less than so much, beside the one they turn most, would
# take all of their strength.
WEAKEST = 0.1


def body_synergies(
    env: EnvBase, num_synergies: int | None = None, *, rest: float = 0.25
) -> SynergyDecoder:
    """A decoder whose coefficients are joint torques, by a body's moment arms; nothing is learned.

    Coefficients of 0 hold every muscle at the activation ``rest``. A coefficient of 1 alone adds
    the torque of its joint: the muscle that pulls most for it comes to about full activation, its
    opponents to none. See :func:`muscle_changes` and :meth:`SynergyDecoder.from_directions`.

    Args:
        env (EnvBase): a body that is moved by muscles alone, after a reset.
        num_synergies (int, optional): d, at most one for each of the J joints that muscles turn.
            Fewer are the combinations of joints that muscles turn most. Default: J.

    Keyword Args:
        rest (float): activation of coefficients 0, in (0, 1). Default: 0.25.

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
    """Changes of activation [d, n] that turn one joint each, or one combination of joints.

    Equation: the rows of the pseudo-inverse of M, the torques with rows of unit length, without
    its singular values below a tenth of the largest, for d < J combined by its first d left
    singular vectors.

    Args:
        torques (array): of each fully active muscle on each joint [J, n].
        num_synergies (int, optional): d, at most J; with all J, synergy i turns joint i alone.

    Returns:
        array: the largest change of each row is 1.

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
                f"num_synergies is {num_synergies}, but muscles turn {joints} joints; give 1 to "
                f"{joints}, or leave it out for one each."
            )
    unit = torques / np.linalg.norm(torques, axis=1, keepdims=True)
    inverse = np.linalg.pinv(unit, rcond=WEAKEST).T
    if num_synergies is not None and num_synergies < joints:
        inverse = np.linalg.svd(unit)[0][:, :num_synergies].T @ inverse
    return inverse / np.abs(inverse).max(1, keepdims=True)


def body_decoder(env: EnvBase, changes: np.ndarray, *, rest: float = 0.25) -> SynergyDecoder:
    """Decodes coefficients into actions whose excitations leave ``rest`` by changes [d, n]."""
    check_real("(0, 1)", rest=rest)
    bounds = env.full_action_spec_unbatched["action"].space
    center, slope = _action_of(env, rest, bounds.low, bounds.high)
    directions = torch.from_numpy(changes).to(center) / slope
    return SynergyDecoder.from_directions(center, directions, low=bounds.low, high=bounds.high)


def _action_of(env: EnvBase, rest: float, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The action [n] whose excitation is ``rest``, and how fast excitation grows there [n]."""
    low, high = low.clone().double(), high.clone().double()
    if not ((excitation(env, low) < rest) & (rest < excitation(env, high))).all():
        raise ValueError(f"rest is {rest}, and no action inside the bounds makes that.")
    for _ in range(60):  # it is increasing: halve the interval
        middle = (low + high) / 2
        below = excitation(env, middle) < rest
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    center = ((low + high) / 2).requires_grad_()
    (slope,) = torch.autograd.grad(excitation(env, center).sum(), center)
    return center.detach().float(), slope.float()
