"""An exponential moving average of weights that does not remember how they began."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

__all__ = ["warmed_up_ema"]


def warmed_up_ema(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Tensor], None]:
    """``multi_avg_fn`` of :class:`~torch.optim.swa_utils.AveragedModel`: an EMA with a warm-up.

    After ``n`` updates the decay is :math:`\\min(decay, (1 + n) / (10 + n))`, as in TensorFlow's
    ``ExponentialMovingAverage``, so that a short run does not show its untrained weights.

    Examples:
        >>> import torch
        >>> average = [torch.tensor([0.0])]
        >>> warmed_up_ema(0.9)(average, [torch.tensor([11.0])], torch.tensor(1))
        >>> average  # the decay is 2 / 11 by now
        [tensor([9.])]
    """

    def update(average: Sequence[Tensor], weights: Sequence[Tensor], updates: Tensor) -> None:
        n = int(updates)
        get_ema_multi_avg_fn(min(decay, (1 + n) / (10 + n)))(average, weights, updates)

    return update
