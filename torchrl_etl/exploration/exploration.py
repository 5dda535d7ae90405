"""Interface of the exploration methods of stage 1."""

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
    """An exploration method: its draws at reset, changes to sampled batches, and losses.

    This base class is plain SAC on the task's reward. Subclasses override what differs; a
    configuration selects one by its kind. ``docs/extend.md`` adds one.

    Args:
        spec (EnvironmentSpec): sizes, bounds and device of the environment.

    Attributes:
        reward (NestedKey): the reward that SAC maximizes in stage 1, below ``"next"``.
        keep (sequence of NestedKey): entries of a transition that the buffer must also keep.
        inputs (mapping): sizes of actor and critic inputs besides the observation, by key.
        trains_policy (bool): whether a policy is trained; if not, updates train only the synergy
            model.
    """

    reward: NestedKey = "reward"
    keep: Sequence[NestedKey] = ()
    inputs: Mapping[str, int]
    trains_policy: ClassVar[bool] = True

    def __init__(self, spec: EnvironmentSpec) -> None:
        self.inputs = {}

    def reset_transforms(self) -> Sequence[Transform]:
        """For the environment: they draw values for an episode. Each simulator gets clones."""
        return ()

    def relabel_transforms(self) -> Sequence[Transform]:
        """For the buffer: they relabel the policy's inputs in every sampled batch."""
        return ()

    def batch_transforms(self) -> Sequence[Transform]:
        """For the learner: applied to each batch at its update, with the current networks.

        They are part of the compiled update: statistics must be buffers, and networks that a
        transform reads must be its submodules or in its attribute ``networks``.
        """
        return ()

    def terms(self) -> Sequence[Term]:
        """Losses that train a representation beside the policy."""
        return ()

    def behavior(self, policy: TensorDictModuleBase) -> TensorDictModuleBase:
        """The behavior policy, given the actor with its noise."""
        return policy

    def embed(self, rows: TensorDictBase) -> tuple[Tensor, Tensor] | None:
        """Embeddings [*, k] and directions [*, k] of transitions from the buffer, if any."""
        return None
