"""Observations in units of what was seen so far."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_etl.checks import check_integer, check_real
from torchrl_etl.modules.running_moments import RunningMoments

__all__ = ["RunningNorm"]


class RunningNorm(RunningMoments):
    """(x - mean) / standard deviation of all observations seen, clipped.

    Joint angles, small pose errors and muscle forces come in one observation; networks that see
    them as they are follow the largest (Lee 2024, SimBa). The statistics are buffers, so that they
    travel with a policy's weights, and only :meth:`see` changes them: a sampled batch is
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
        >>> norm.see(torch.tensor([[1.0], [3.0]]))
        >>> norm(torch.tensor([4.0]))  # mean 2, deviation 1
        tensor([2.])
    """

    def __init__(self, size: int, *, clip: float = 10.0) -> None:
        check_integer(1, size=size)
        check_real("(0, inf)", clip=clip)
        super().__init__((size,))
        self.clip = clip

    def forward(self, observation: Tensor) -> Tensor:
        """Observations [*, size] in standard deviations; as they are before any was seen."""
        if not observation.is_floating_point():  # of whose dtype the mean would be
            observation = observation.float()
        # What never varied stays where it is, at zero, rather than being blown up.
        std = torch.where(self.variance > 1e-12, self.variance, 1.0).sqrt()
        normalized = (observation - self.mean.to(observation)) / std.to(observation)
        return normalized.clamp(-self.clip, self.clip)
