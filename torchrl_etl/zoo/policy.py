"""Rebuilds a trained learner's policy from the description in its card."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from torchrl.data import Bounded

from torchrl_etl.baselines import make_dynsyn_actor, make_lattice_actor
from torchrl_etl.checks import check_choice
from torchrl_etl.learners import NORMALIZED, from_observation
from torchrl_etl.modules import RunningNorm, SynergyMap, describe_map, make_actor, make_map

__all__ = ["ACTORS", "describe_decoder", "make_policy"]

ACTORS: dict[str, Callable[..., ProbabilisticTensorDictSequential]] = {
    "gaussian": make_actor,
    "lattice": make_lattice_actor,
    "dynsyn": make_dynsyn_actor,
}
"""Factory functions of actors by kind."""

_RENAMED = {"quiet": "fixed_std_dims", "quiet_std": "fixed_std"}  # in older cards


def make_policy(
    *,
    observation_dim: int,
    low: list[float],
    high: list[float],
    actor: Mapping[str, Any],
    decoder: Mapping[str, Any] | None = None,
    normalize_observations: bool = False,
) -> TensorDictModuleBase:
    """The policy of a :class:`~torchrl_etl.learners.SACLearner`, before its weights are loaded.

    By default it is deterministic; it samples if a collector sets that exploration type.

    Keyword Args:
        observation_dim (int): size of an observation.
        low, high (list of float): bounds of the action [n].
        actor (mapping): its ``kind``, one of :data:`ACTORS`, and arguments of that function.
        decoder (mapping, optional): description from :func:`describe_decoder`.
        normalize_observations (bool): whether the actor reads normalized observations.

    Raises:
        TypeError, ValueError: for invalid arguments.

    Examples:
        >>> policy = make_policy(
        ...     observation_dim=3, low=[-1.0] * 2, high=[1.0] * 2, actor={"kind": "gaussian"}
        ... )
        >>> policy.in_keys, policy.out_keys
        (['observation'], ['loc', 'scale', 'action'])
    """
    options = {_RENAMED.get(name, name): value for name, value in actor.items()}
    check_choice("kind", kind := options.pop("kind", None), list(ACTORS))
    # These initial weights will be overwritten, so keep the global generator unchanged.
    with torch.random.fork_rng(devices=[]):
        emitted, out_key, map_ = _spec(low, high), "action", None
        if decoder is not None:
            map_ = make_map({**decoder, "action_dim": len(low), "low": low, "high": high})
            emitted, out_key = map_.synergy_spec, map_.in_keys[0]
        norm = RunningNorm(observation_dim) if normalize_observations else None
        inputs = {"observation" if norm is None else NORMALIZED: observation_dim}
        policy = from_observation(
            ACTORS[kind](inputs, emitted, out_key=out_key, **options), norm, map_
        )
    for module in policy.modules():
        if isinstance(module, ProbabilisticTensorDictModule):
            module.default_interaction_type = InteractionType.DETERMINISTIC
    return policy.requires_grad_(False).eval()


def describe_decoder(decoder: SynergyMap | None) -> dict[str, Any] | None:
    """The ``decoder`` argument of :func:`make_policy` for a decoder.

    It leaves out what the card has already: the action's size and bounds.

    Raises:
        ValueError: if it is not a :class:`~torchrl_etl.modules.SynergyMap`.

    Examples:
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> describe_decoder(SynergyDecoder(2, 3, hidden=[8]))
        {'kind': 'synergies', 'num_synergies': 2, 'hidden': [8], 'residual': 0.0}
    """
    if decoder is None:
        return None
    described = describe_map(decoder)
    return {key: described[key] for key in described if key not in ("action_dim", "low", "high")}


def _spec(low: list[float], high: list[float]) -> Bounded:
    bounds = torch.tensor(low), torch.tensor(high)
    return Bounded(*bounds, shape=bounds[0].shape, dtype=torch.float32)
