"""Select the actions of a batch on which a synergy model is trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_etl.checks import check_choice

__all__ = ["ActionSelector"]

Actions = Literal["policy", "mean", "sampled", "activation"]


class ActionSelector:
    """Selects from a batch of transitions the actions on which a synergy model is trained.

    Deviates: Algorithm 1 has "collected action data". Actions sampled from a maximum-entropy policy
    are nearly white noise, which few synergies cannot explain. The default is therefore the current
    policy's mean action (``"policy"``); ``"sampled"`` is as printed.

    Args:
        actor (ProbabilisticTensorDictSequential): the policy.

    Keyword Args:
        actions (str): ``"policy"``: mean actions of the current policy; ``"mean"``: mean actions of
            the policy that collected them; ``"sampled"``: executed actions; ``"activation"``:
            muscle activations in action units.
    """

    def __init__(
        self, actor: ProbabilisticTensorDictSequential, *, actions: Actions = "policy"
    ) -> None:
        check_choice("actions", actions, get_args(Actions))
        self.actor, self.actions = actor, actions

    @property
    def keep(self) -> Sequence[NestedKey]:
        """Entries of a transition that the buffer must keep."""
        return {"mean": ("loc", "scale"), "activation": (("next", "activation"),)}.get(
            self.actions, ()
        )

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """A tensordict with the selected ``action`` [*, n]."""
        actions = self._of(batch)
        return TensorDict({"action": actions}, actions.shape[:1])

    def _of(self, batch: TensorDictBase) -> Tensor:
        match self.actions:
            case "policy":
                inputs = batch.select(*self.actor.in_keys)
                return self.actor.get_dist(inputs).deterministic_sample
            case "mean":
                return self.actor.build_dist_from_params(batch).deterministic_sample
            case "activation":
                return batch["next", "activation"]
        return batch["action"]
