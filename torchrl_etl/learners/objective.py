"""What a learner minimizes on a batch: SAC's losses and the terms beside them."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_etl.learners.term import Term
from torchrl_etl.modules import ReturnScale, RunningNorm
from torchrl_etl.objectives import LeanSACLoss

__all__ = ["NORMALIZED", "Objective"]

NORMALIZED = "normalized_observation"
"""What actor and critics read where observations are normalized."""


class Objective(nn.Module):
    """A function of parameters and a batch, without any state that it changes.

    Args:
        sac (LeanSACLoss): the losses of actor, critics and temperature.
        actor (TensorDictModuleBase): that actor, for terms that ask it for actions.
        terms (sequence of Term): what is minimized beside them.

    Keyword Args:
        normalizer (RunningNorm, optional): scales the observations that actor and critics read.
        return_scale (ReturnScale, optional): scales the reward that SAC learns on.
        reward (NestedKey): that reward, below ``"next"``. Default: ``"reward"``.
    """

    def __init__(
        self,
        sac: LeanSACLoss,
        actor: TensorDictModuleBase,
        terms: Sequence[Term] = (),
        *,
        normalizer: RunningNorm | None = None,
        return_scale: ReturnScale | None = None,
        reward: NestedKey = "reward",
    ) -> None:
        super().__init__()
        self.sac, self.actor, self.terms = sac, actor, nn.ModuleList(terms)
        self.normalizer, self.return_scale, self.reward = normalizer, return_scale, reward
        sac.set_keys(reward=reward)

    def forward(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """The sum of all losses, and scalars to log; the batch [B] is left as it is."""
        batch = self.prepare(batch)
        scalars = self.sac(batch)
        loss = scalars["loss_actor"] + scalars["loss_qvalue"] + scalars["loss_alpha"]
        for term in self.terms:
            extra, logged = term(batch)
            loss = loss + extra
            scalars.update(logged)
        if self.reward != "reward":  # a bonus: worth a look beside the task's reward
            scalars[self.reward] = batch["next", self.reward].mean()
        return loss, scalars

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch with observations and reward in the units of what was seen up to now."""
        batch = batch.copy()
        if self.normalizer is not None:
            for end in (batch, batch["next"]):
                end[NORMALIZED] = self.normalizer(end["observation"])
        if self.return_scale is not None:
            batch["next", self.reward] = self.return_scale(batch["next", self.reward])
        return batch
