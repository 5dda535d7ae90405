"""Observations in units of what was seen so far."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["RunningNorm"]


class RunningNorm(nn.Module):
    """(x - mean) / standard deviation of all observations seen, clipped.

    Joint angles, small pose errors and muscle forces come in one observation; networks that see
    them as they are follow the largest (Lee 2024, SimBa). The statistics are buffers, so that they
    travel with a policy's weights, and only :meth:`update` changes them: a sampled batch is
    normalized by the same numbers as a step in the environment.

    Args:
        size (int): entries of an observation.

    Keyword Args:
        clip (float): largest magnitude of an entry of the output. Default: 10.

    Raises:
        ValueError: if size or clip are not positive.

    Examples:
        >>> import torch
        >>> from torchrl_etl.modules import RunningNorm
        >>> norm = RunningNorm(1)
        >>> norm.update(torch.tensor([[1.0], [3.0]]))
        >>> norm(torch.tensor([4.0]))  # mean 2, deviation 1
        tensor([2.])
    """

    def __init__(self, size: int, *, clip: float = 10.0) -> None:
        super().__init__()
        if size < 1:
            raise ValueError(f"size is {size}; it is the length of an observation, 1 or more.")
        if not clip > 0.0:
            raise ValueError(f"clip is {clip}; it is the largest magnitude and must be above 0.")
        self.clip = clip
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))

    @torch.no_grad()
    def update(self, observation: Tensor) -> None:
        """See observations [*, size]."""
        rows = observation.reshape(-1, observation.shape[-1]).to(self.mean)
        # Chan's parallel variance: exact, whatever the batches are.
        count, shift = self.count + len(rows), rows.mean(0) - self.mean
        squares = (rows - rows.mean(0)).square().sum(0)
        self.squares += squares + shift.square() * self.count * len(rows) / count
        self.mean += shift * len(rows) / count
        self.count.copy_(count)

    def forward(self, observation: Tensor) -> Tensor:
        """Observations [*, size] in standard deviations; as they are before any was seen."""
        variance = self.squares / self.count.clamp(min=1)
        # What never varied stays where it is, at zero, rather than being blown up.
        std = torch.where(variance > 1e-12, variance, 1.0).sqrt()
        normalized = (observation - self.mean.to(observation)) / std.to(observation)
        return normalized.clamp(-self.clip, self.clip)
