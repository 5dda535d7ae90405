"""An exponential moving average of weights with a warm-up."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

__all__ = ["WarmedUpEMA"]


class WarmedUpEMA(AveragedModel):
    """A copy of a model whose weights are an EMA of the model's, with a warm-up.

    After ``n`` updates the decay is :math:`\\min(decay, (1 + n) / (10 + n))`, as in TensorFlow's
    ``ExponentialMovingAverage``, so that initial weights soon lose their influence. Buffers are
    copied.

    PyTorch's ``update_parameters`` with an equivalent ``multi_avg_fn`` gives the same numbers but
    takes several times as long, because it collects and sorts all tensors at each call.

    Args:
        model (nn.Module): must keep its tensors, which are collected once.
        decay (float): in [0, 1); 0 copies the weights.

    Examples:
        >>> import torch
        >>> from torchrl_etl.learners import WarmedUpEMA
        >>> model = torch.nn.Linear(1, 1, bias=False)
        >>> ema = WarmedUpEMA(model, decay=0.9)
        >>> for weight in (0.0, 11.0):
        ...     _ = torch.nn.init.constant_(model.weight, weight)
        ...     ema.update()
        >>> ema.module.weight.item()  # the decay was 2 / 11
        9.0
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        super().__init__(model)
        self.decay = decay
        self._parameters_of = list(self.module.parameters()), list(model.parameters())
        self._buffers_of = list(self.module.buffers()), list(model.buffers())

    @torch.no_grad()
    def update(self) -> None:
        """Update the average with the current weights."""
        n = int(self.n_averaged)
        decay = min(self.decay, (1 + n) / (10 + n)) if n else 0.0
        if self._parameters_of[0]:
            torch._foreach_lerp_(*self._parameters_of, 1 - decay)
        if self._buffers_of[0]:
            torch._foreach_copy_(*self._buffers_of)
        self.n_averaged += 1

    @property
    def tensors(self) -> list[Tensor]:
        """Every tensor that :meth:`update` reads or modifies, except the update counter."""
        both = *self._parameters_of, *self._buffers_of
        return [tensor for each in both for tensor in each]

    def mapped(self, other: Callable[[Tensor], Tensor]) -> WarmedUpEMA:
        """A copy for ``other(tensor)`` of each tensor; the two share one update counter."""
        twin = copy(self)  # shares the buffer ``n_averaged``
        twin._parameters_of = tuple(list(map(other, each)) for each in self._parameters_of)
        twin._buffers_of = tuple(list(map(other, each)) for each in self._buffers_of)
        return twin
