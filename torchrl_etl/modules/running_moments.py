"""Mean and variance of everything seen so far."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_etl.checks import check_width

__all__ = ["RunningMoments"]


class RunningMoments(nn.Module):
    """Running mean and variance in double precision, in buffers that go with the state dict.

    Args:
        shape (sequence of int): shape of one value. Default: a scalar.

    Examples:
        >>> import torch
        >>> moments = RunningMoments()
        >>> moments.update_moments(torch.tensor([1.0, 3.0]))
        >>> moments.mean.item(), moments.variance.item()
        (2.0, 1.0)
    """

    count: Tensor
    mean: Tensor
    squares: Tensor

    def __init__(self, shape: Sequence[int] = ()) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        for name in ("mean", "squares"):
            self.register_buffer(name, torch.zeros(tuple(shape), dtype=torch.float64))

    @torch.no_grad()
    def update_moments(self, values: Tensor) -> None:
        """Update with values [*, *shape], possibly none."""
        if self.mean.ndim:
            check_width(self.mean.shape[-1], values=values)
        rows = values.reshape(-1, *self.mean.shape).to(self.mean)
        if not len(rows):
            return
        # Chan's parallel variance: exact for any batch sizes.
        count, mean = self.count + len(rows), rows.mean(0)
        shift = mean - self.mean
        self.squares += (rows - mean).square().sum(0)
        self.squares += shift.square() * self.count * len(rows) / count
        self.mean += shift * len(rows) / count
        self.count.copy_(count)

    @property
    def variance(self) -> Tensor:
        """Population variance of all values seen; zero before any."""
        return self.squares / self.count.clamp(min=1)
