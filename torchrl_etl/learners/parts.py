"""Parts of a SAC learner: loss, reward scaling, target entropy, and the policy that acts."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor
from torchrl.data import Bounded

from torchrl_etl.checks import check_integer, check_real, renaming
from torchrl_etl.learners.objective import NORMALIZED
from torchrl_etl.modules import ReturnScale, RunningNorm, SynergyMap
from torchrl_etl.objectives import LeanSACLoss, SynergySACLoss

__all__ = [
    "entropy_target",
    "episode_numbers",
    "from_observation",
    "make_loss",
    "make_return_scale",
]


def make_loss(
    actor: ProbabilisticTensorDictSequential,
    critic: TensorDictModule,
    gamma: float,
    return_bound: float | None,
    *,
    decoder: SynergyMap | None,
    train_decoder: bool,
    alpha_init: float,
    num_critics: int,
    bins: int,
    **options: Any,
) -> LeanSACLoss:
    """SAC losses over actions, or over synergies that ``decoder`` maps to actions."""
    check_real("[0, 1)", gamma=gamma)
    check_real("(0, inf)", alpha_init=alpha_init)
    check_integer(1, num_critics=num_critics, bins=bins)
    options |= {"alpha_init": alpha_init, "num_qvalue_nets": num_critics}
    options["support"] = support(bins, return_bound)
    if decoder is None:
        sac = LeanSACLoss(actor, critic, **options)
    else:
        sac = SynergySACLoss(actor, critic, decoder, train_decoder=train_decoder, **options)
    sac.make_value_estimator(gamma=gamma)
    _ = sac.target_entropy  # created lazily; it must exist before the optimizer does
    return sac


def make_return_scale(gamma: float, return_bound: float | None) -> ReturnScale | None:
    """Reward scaling that keeps returns within ±``return_bound``; ``None`` without a bound."""
    if return_bound is None:
        return None
    with renaming(bound="return_bound"):
        return ReturnScale(gamma, bound=return_bound)


def from_observation(
    actor: TensorDictModuleBase, normalizer: RunningNorm | None, decoder: SynergyMap | None
) -> TensorDictModuleBase:
    """Wrap an actor to act in an environment: it reads raw observations and writes actions."""
    before, after = [], [] if decoder is None else [decoder]
    if normalizer is not None:
        before = [TensorDictModule(normalizer, ["observation"], [NORMALIZED])]
    return TensorDictSequential(*before, actor, *after) if before or after else actor


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


def episode_numbers(batch: TensorDictBase) -> Tensor:
    """An episode number for each transition [*], unique across workers.

    Workers of one machine share a numbering; each remote worker has its own.
    """
    number = batch["collector", "traj_ids"]
    worker = batch.get(("collector", "worker"), None)
    return number if worker is None else number + (worker << 32)
