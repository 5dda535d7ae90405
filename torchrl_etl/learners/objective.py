"""The objective that a learner minimizes on a batch: SAC's losses and additional terms."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.transforms import Transform

from torchrl_etl.learners.term import Term
from torchrl_etl.modules import ReturnScale, RunningNorm
from torchrl_etl.objectives import LeanSACLoss

__all__ = ["NORMALIZED", "Objective"]

NORMALIZED = "normalized_observation"
"""Key that actor and critics read if observations are normalized."""


class Objective(nn.Module):
    """A function of parameters and a batch; calling it modifies only :attr:`statistics`.

    Args:
        sac (LeanSACLoss, optional): the losses of actor, critics and temperature.
        actor (TensorDictModuleBase): the actor, for terms that query it for actions.
        terms (sequence of Term): losses to add to SAC's.

    Keyword Args:
        normalizer (RunningNorm, optional): normalizes the observations for actor and critics.
        return_scale (ReturnScale, optional): scales the reward that SAC learns from.
        reward (NestedKey): that reward, below ``"next"``. Default: ``"reward"``.
        transforms (sequence of Transform): applied to each batch first, without gradients and with
            the current networks. The attribute ``networks`` of a transform lists networks that it
            reads but does not own; it may modify their buffers if a term holds them.
    """

    def __init__(
        self,
        sac: LeanSACLoss | None,
        actor: TensorDictModuleBase,
        terms: Sequence[Term] = (),
        *,
        normalizer: RunningNorm | None = None,
        return_scale: ReturnScale | None = None,
        reward: NestedKey = "reward",
        transforms: Sequence[Transform] = (),
    ) -> None:
        super().__init__()
        self.sac, self.actor, self.terms = sac, actor, nn.ModuleList(terms)
        self.normalizer, self.return_scale, self.reward = normalizer, return_scale, reward
        self.transforms = nn.ModuleList(transforms)
        # A tuple, so they are no submodules: their owners train and save them.
        self.networks = tuple(own for each in transforms for own in getattr(each, "networks", ()))
        if sac is not None:
            sac.set_keys(reward=reward)

    def forward(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """The sum of all losses, and scalars to log; leaves the batch [B] unchanged."""
        batch = self.prepare(batch)
        loss, scalars = 0.0, TensorDict()
        if self.sac is not None:
            scalars = self.sac(batch)
            loss = scalars["loss_actor"] + scalars["loss_qvalue"] + scalars["loss_alpha"]
        for term in self.terms:
            extra, logged = term(batch)
            loss = loss + extra
            scalars.update(logged)
        if self.reward != "reward":  # an intrinsic bonus, logged besides the task's reward
            scalars[self.reward] = batch["next", self.reward].mean()
        return loss, scalars

    def only(self, *terms: Term) -> Objective:
        """An objective of these terms only, with the same normalizer."""
        return Objective(None, self.actor, terms, normalizer=self.normalizer)

    @property
    def statistics(self) -> dict[str, Tensor]:
        """Buffers that transforms may modify, such as running means, by name in this module."""
        changing = {id(own) for own in nn.ModuleList([*self.transforms, *self.networks]).buffers()}
        return {
            name: own
            for prefix, module in self.named_modules()
            if not isinstance(module, TensorDictParams)  # target parameters of a loss
            for name, own in module.named_buffers(prefix, recurse=False)
            if id(own) in changing
        }

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """A transformed copy of the batch, with normalized observations and scaled reward."""
        batch = batch.copy()
        with torch.no_grad():
            for transform in self.transforms:
                batch = transform(batch)
        if self.normalizer is not None:
            for end in (batch, batch["next"]):
                end[NORMALIZED] = self.normalizer(end["observation"])
        if self.return_scale is not None:
            batch["next", self.reward] = self.return_scale(batch["next", self.reward])
        return batch
