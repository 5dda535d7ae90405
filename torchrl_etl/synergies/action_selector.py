"""Select the actions of a batch on which a synergy model is trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_etl.checks import check_choice, check_real

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
        best_share (float): fraction of a batch to select, by highest reward. Default: 1.
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        *,
        actions: Actions = "policy",
        best_share: float = 1.0,
    ) -> None:
        check_choice("actions", actions, get_args(Actions))
        check_real("(0, 1]", best_share=best_share)
        if best_share < 1 and actions == "policy":
            raise ValueError(
                f"best_share is {best_share} and selects by reward, but actions=policy uses fresh "
                "actions, which have no recorded reward; use actions=mean."
            )
        self.actor, self.actions, self.best_share = actor, actions, best_share

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
        if self.best_share < 1:
            count = max(1, round(self.best_share * len(actions)))
            actions = actions[batch["next", "reward"].squeeze(-1).topk(count).indices]
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
