"""What stage 1 needs to know of a way to explore."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.transforms import Transform

from torchrl_etl.envs import EnvironmentSpec
from torchrl_etl.learners.term import Term

__all__ = ["Exploration"]


class Exploration:
    """A way to explore: what is drawn at reset, what a sampled batch gets, what is trained.

    This one is SAC on the task's reward, without anything added. Others override what differs, in
    a file of their own that a configuration names by its kind; ``docs/extend.md`` adds one.

    Args:
        spec (EnvironmentSpec): sizes, bounds and device of the environment.

    Attributes:
        reward (NestedKey): what SAC learns on in stage 1, below ``"next"``.
        keep (sequence of NestedKey): entries of a transition that the buffer must keep for it.
        inputs (mapping): sizes of what actor and critics read beside the observation, by key.
        learns (bool): whether a policy does; if not, updates train the synergy model alone.
    """

    reward: NestedKey = "reward"
    keep: Sequence[NestedKey] = ()
    inputs: Mapping[str, int]
    learns: ClassVar[bool] = True

    def __init__(self, spec: EnvironmentSpec) -> None:
        self.inputs = {}

    def reset_transforms(self) -> Sequence[Transform]:
        """For the environment: they draw what holds for an episode. Each simulator gets clones."""
        return ()

    def relabel_transforms(self) -> Sequence[Transform]:
        """For the buffer: they replace, in every sampled batch, what the policy reads."""
        return ()

    def batch_transforms(self) -> Sequence[Transform]:
        """For the learner: what each batch gets at its update, with all networks as they then are.

        They are part of the compiled update: statistics are buffers, and networks that one reads
        are submodules of it or in its attribute ``networks``.
        """
        return ()

    def terms(self) -> Sequence[Term]:
        """Losses that train a representation beside the policy."""
        return ()

    def behavior(self, policy: TensorDictModuleBase) -> TensorDictModuleBase:
        """What collects, given the actor with its noise."""
        return policy

    def embed(self, rows: TensorDictBase) -> tuple[Tensor, Tensor] | None:
        """Embeddings [*, k] and directions [*, k] of transitions as the buffer has them, if any."""
        return None
