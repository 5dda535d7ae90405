"""Normalization of observations by running statistics."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_etl.checks import check_integer, check_real
from torchrl_etl.modules.running_moments import RunningMoments

__all__ = ["RunningNorm"]


class RunningNorm(RunningMoments):
    """(x - mean) / standard deviation of all observations seen, clipped.

    Joint angles, small pose errors and muscle forces come in one observation; without normalization
    the largest dominate (SimBa, Lee 2024). The statistics are buffers, so they travel with a
    policy's weights. Only :meth:`update_moments` changes them: sampled batches and environment
    steps are normalized by the same numbers.

    Args:
        size (int): size of an observation.

    Keyword Args:
        clip (float): largest absolute value of the output. Default: 10.

    Raises:
        ValueError: if size or clip are not positive.

    Examples:
        >>> import torch
        >>> from torchrl_etl.modules import RunningNorm
        >>> norm = RunningNorm(1)
        >>> norm.update_moments(torch.tensor([[1.0], [3.0]]))
        >>> norm(torch.tensor([4.0]))  # mean 2, deviation 1
        tensor([2.])
    """

    def __init__(self, size: int, *, clip: float = 10.0) -> None:
        check_integer(1, size=size)
        check_real("(0, inf)", clip=clip)
        super().__init__((size,))
        self.clip = clip

    def forward(self, observation: Tensor) -> Tensor:
        """Normalized observations [*, size]; only clipped before any were seen."""
        if not observation.is_floating_point():  # or the mean would become an integer
            observation = observation.float()
        # Entries that never varied are only centered, not blown up.
        std = torch.where(self.variance > 1e-12, self.variance, 1.0).sqrt()
        normalized = (observation - self.mean.to(observation)) / std.to(observation)
        return normalized.clamp(-self.clip, self.clip)
