"""What a learner minimizes on a batch: SAC's losses and the terms beside them."""

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
"""What actor and critics read where observations are normalized."""


class Objective(nn.Module):
    """A function of parameters and a batch; calling it changes nothing but :attr:`statistics`.

    Args:
        sac (LeanSACLoss, optional): the losses of actor, critics and temperature.
        actor (TensorDictModuleBase): that actor, for terms that ask it for actions.
        terms (sequence of Term): what is minimized beside them.

    Keyword Args:
        normalizer (RunningNorm, optional): scales the observations that actor and critics read.
        return_scale (ReturnScale, optional): scales the reward that SAC learns on.
        reward (NestedKey): that reward, below ``"next"``. Default: ``"reward"``.
        transforms (sequence of Transform): what each batch goes through first, without gradients
            and with all networks as they are by then; those that they read and do not hold are
            their ``networks``, whose buffers they may change if a term holds them, too.
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
        # In a tuple they are no part of it: whoever trains them saves them.
        self.networks = tuple(own for each in transforms for own in getattr(each, "networks", ()))
        if sac is not None:
            sac.set_keys(reward=reward)

    def forward(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """The sum of all losses, and scalars to log; the batch [B] is left as it is."""
        batch = self.prepare(batch)
        loss, scalars = 0.0, TensorDict()
        if self.sac is not None:
            scalars = self.sac(batch)
            loss = scalars["loss_actor"] + scalars["loss_qvalue"] + scalars["loss_alpha"]
        for term in self.terms:
            extra, logged = term(batch)
            loss = loss + extra
            scalars.update(logged)
        if self.reward != "reward":  # a bonus: worth a look beside the task's reward
            scalars[self.reward] = batch["next", self.reward].mean()
        return loss, scalars

    def only(self, *terms: Term) -> Objective:
        """These terms alone, on the same observations."""
        return Objective(None, self.actor, terms, normalizer=self.normalizer)

    @property
    def statistics(self) -> dict[str, Tensor]:
        """What transforms may change, by their names in this module: buffers, as running means."""
        changing = {id(own) for own in nn.ModuleList([*self.transforms, *self.networks]).buffers()}
        return {
            name: own
            for prefix, module in self.named_modules()
            if not isinstance(module, TensorDictParams)  # targets of a loss, which follow
            for name, own in module.named_buffers(prefix, recurse=False)
            if id(own) in changing
        }

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch as transforms make it, observations and reward in units of those so far."""
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
