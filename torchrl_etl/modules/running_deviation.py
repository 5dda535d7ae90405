"""Running mean and standard deviation of a drifting scalar."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_etl.checks import check_real

__all__ = ["RunningDeviation"]


class RunningDeviation(nn.Module):
    """Bias-corrected EMA of a scalar's mean and variance; the first update has full weight.

    Args:
        decay (float): in (0, 1); an update has weight ``1 - decay``.

    Examples:
        >>> import torch
        >>> from torchrl_etl.modules.running_deviation import RunningDeviation
        >>> deviation = RunningDeviation(decay=0.9)
        >>> deviation.update(torch.tensor([1.0, 5.0]))
        >>> deviation.divisor
        tensor(2.)
    """

    mean: Tensor
    variance: Tensor
    weight: Tensor

    # Keeps the root mean square of divided values at 10 or less when they hardly vary.
    _FLOOR = 0.1
    _EPSILON = 1e-6

    def __init__(self, decay: float) -> None:
        super().__init__()
        check_real("(0, 1)", decay=decay)
        self.decay = decay
        self.register_buffer("mean", torch.zeros(()))
        # Only makes the divisor 1 before the first update, which has full weight.
        self.register_buffer("variance", torch.ones(()))
        self.register_buffer("weight", torch.zeros(()))

    def update(self, values: Tensor) -> None:
        if not values.numel():
            return
        if self.mean.device != values.device:
            self.to(values.device)
        self.weight.mul_(self.decay).add_(1 - self.decay)
        step = (1 - self.decay) / self.weight
        change = values.mean() - self.mean
        self.mean.add_(step * change)
        between = step * change.square()
        self.variance.add_(between).mul_(1 - step).add_(step * values.var(correction=0))

    @property
    def divisor(self) -> Tensor:
        """Standard deviation, at least a tenth of the root mean square; 1 before any update."""
        floor = self._FLOOR**2 * (self.variance + self.mean.square())
        return torch.maximum(self.variance, floor).sqrt().clamp_min(self._EPSILON)
