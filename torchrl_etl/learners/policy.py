"""The policy that acts in an environment."""

from __future__ import annotations

from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential

from torchrl_etl.learners.objective import NORMALIZED
from torchrl_etl.modules import RunningNorm, SynergyMap

__all__ = ["from_observation"]


def from_observation(
    actor: TensorDictModuleBase, normalizer: RunningNorm | None, decoder: SynergyMap | None
) -> TensorDictModuleBase:
    """Wrap an actor to act in an environment: it reads raw observations and writes actions."""
    before, after = [], [] if decoder is None else [decoder]
    if normalizer is not None:
        before = [TensorDictModule(normalizer, ["observation"], [NORMALIZED])]
    return TensorDictSequential(*before, actor, *after) if before or after else actor
