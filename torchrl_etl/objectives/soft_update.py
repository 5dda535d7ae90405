"""Soft update of target networks in one operation."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import torch
from torch import Tensor
from torchrl.objectives import SoftUpdate

__all__ = ["FusedSoftUpdate"]


class FusedSoftUpdate(SoftUpdate):
    """:class:`torchrl.objectives.SoftUpdate` of all parameters at once instead of one by one.

    Args:
        loss_module (LossModule): the loss whose target parameters are updated.

    Keyword Args:
        tau (float) or eps (float): see :class:`torchrl.objectives.SoftUpdate`.

    Examples:
        >>> from torchrl_etl.modules import StateEncoder
        >>> from torchrl_etl.objectives import BehavioralMetricLoss, FusedSoftUpdate
        >>> loss = BehavioralMetricLoss(StateEncoder(observation_dim=7, embedding_dim=4))
        >>> updater = FusedSoftUpdate(loss, tau=0.01)
        >>> updater.step()
    """

    def init_(self) -> None:
        super().init_()
        pairs = (
            (self._targets.get((f"target_{name}", *key)), source)
            for (name, *key), source in self._sources.items(True, True)
        )
        self.target_tensors, self.source_tensors = map(list, zip(*pairs, strict=True))

    @torch.no_grad()
    def step(self) -> None:
        torch._foreach_lerp_(self.target_tensors, self.source_tensors, 1 - self.eps)

    def mapped(self, other: Callable[[Tensor], Tensor]) -> FusedSoftUpdate:
        """The same update with each tensor replaced by ``other(tensor)``."""
        twin = copy(self)
        twin.target_tensors = list(map(other, self.target_tensors))
        twin.source_tensors = list(map(other, self.source_tensors))
        return twin
