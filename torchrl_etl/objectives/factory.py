"""The SAC loss of a learner, built from plain settings."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.data import Bounded

from torchrl_etl.checks import check_integer, check_real
from torchrl_etl.modules import SynergyMap
from torchrl_etl.objectives.sac import LeanSACLoss
from torchrl_etl.objectives.synergy_sac import SynergySACLoss

__all__ = ["entropy_target", "make_sac_loss"]


def make_sac_loss(
    actor: ProbabilisticTensorDictSequential,
    critic: TensorDictModule,
    decoder: SynergyMap | None = None,
    *,
    gamma: float = 0.99,
    alpha_init: float = 1.0,
    num_critics: int = 2,
    bins: int = 1,
    return_bound: float | None = None,
    **options: Any,
) -> LeanSACLoss:
    """SAC's losses over actions, or over synergies that ``decoder`` maps to actions.

    Args:
        actor (ProbabilisticTensorDictSequential): writes an action, or what ``decoder`` reads.
        critic (TensorDictModule): Q-network, copied ``num_critics`` times.
        decoder (SynergyMap, optional): maps the actor's output to actions.

    Keyword Args:
        gamma (float): discount factor.
        alpha_init (float): initial temperature.
        num_critics (int): ensemble size; targets and actor loss use the minimum.
        bins (int): above 1, critics are categorical with ``bins`` atoms in ±``return_bound``.
        return_bound (float, optional): largest return, in units of the reward that the loss reads.
        **options: see :class:`LeanSACLoss` and, with a decoder, :class:`SynergySACLoss`;
            ``action_spec`` is the unbatched spec of the actor's output.

    Raises:
        ValueError: if a number is out of range, or ``bins`` is above 1 without ``return_bound``.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.modules import make_actor, make_critic
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> actor = make_actor({"observation": 3}, spec)
        >>> critic = make_critic({"observation": 3, "action": 2}, bins=51)
        >>> loss = make_sac_loss(actor, critic, action_spec=spec, bins=51, return_bound=5.0)
    """
    check_real("[0, 1)", gamma=gamma)
    check_real("(0, inf)", alpha_init=alpha_init)
    check_integer(1, num_critics=num_critics, bins=bins)
    if return_bound is not None:
        check_real("(0, inf)", return_bound=return_bound)
    options |= {"alpha_init": alpha_init, "num_qvalue_nets": num_critics}
    options["support"] = support(bins, return_bound)
    if decoder is None:
        sac = LeanSACLoss(actor, critic, **options)
    else:
        sac = SynergySACLoss(actor, critic, decoder, **options)
    sac.make_value_estimator(gamma=gamma)
    return sac


def support(bins: int, bound: float | None) -> Tensor | None:
    """Atoms of categorical critics; ``None`` for scalar critics (``bins=1``).

    Examples:
        >>> support(3, 5.0)
        tensor([-5.,  0.,  5.])
    """
    if bins == 1:
        return None
    if bound is None:
        raise ValueError(
            f"return_bound is null but critics have {bins} bins; categorical critics need a bound "
            "on returns, such as return_bound=5."
        )
    return torch.linspace(-bound, bound, bins)


def entropy_target(action_spec: Bounded, action_std: float | None) -> float:
    """Entropy of a Gaussian whose std in each dimension is ``action_std`` times the half range.

    ``None`` gives SAC's usual target, minus the number of dimensions.

    Examples:
        >>> from torchrl.data import Bounded
        >>> round(entropy_target(Bounded(-1, 1, shape=(2,)), action_std=1.0), 3)  # ln(2πe)
        2.838
        >>> round(entropy_target(Bounded(0, 1, shape=(2,)), action_std=1.0), 3)  # half as wide
        1.452
    """
    if action_std is None:
        return -float(action_spec.shape.numel())
    check_real("(0, inf)", action_std=action_std)
    half_range = (action_spec.space.high - action_spec.space.low) / 2
    return float((half_range * action_std * math.sqrt(2 * math.pi * math.e)).log().sum())
