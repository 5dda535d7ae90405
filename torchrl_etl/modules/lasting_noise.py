"""Standard normal noise that is correlated over time.

Call an instance once per step, with the simulators in the same order. Each call draws numbers for
all of them, so the random stream does not depend on which are used. Noise starts anew with each
episode.
"""

from __future__ import annotations

import math
from typing import TypeGuard

import torch
from torch import Tensor

from torchrl_etl.checks import check_integer, check_real

__all__ = ["HeldNormal", "PinkNormal"]


class HeldNormal:
    """Noise drawn once and held for k steps, P(k) ∝ k^-exponent, k ≤ longest (FlashSAC, 2026).

    Args:
        longest (int): longest hold, in steps.
        exponent (float): above 0; larger is shorter. Default: 2.

    Raises:
        ValueError: if exponent or longest are not positive.

    Examples:
        >>> held = HeldNormal(longest=16)
        >>> held(torch.zeros(4, 2), is_init=torch.ones(4, dtype=torch.bool)).shape
        torch.Size([4, 2])
    """

    def __init__(self, longest: int, exponent: float = 2.0) -> None:
        check_real("(0, inf)", exponent=exponent)
        check_integer(1, longest=longest)
        self._chances = torch.arange(1, longest + 1, dtype=torch.float64).pow(-exponent)
        self._noise: Tensor | None = None
        self._left: Tensor

    def __call__(self, like: Tensor, is_init: Tensor) -> Tensor:
        """Noise [*, n] of this step in the dtype of ``like``; ``is_init`` [*] marks where an
        episode begins."""
        if not _is_like(self._noise, like):
            self._noise = torch.zeros_like(like)
            self._left = torch.zeros_like(is_init, dtype=torch.long)
        lengths = 1 + torch.multinomial(self._chances, is_init.numel(), replacement=True)
        fresh = is_init | (self._left == 0)
        drawn = torch.randn_like(like)
        self._left = torch.where(fresh, lengths.to(is_init.device).view_as(is_init), self._left) - 1
        self._noise = torch.where(fresh.unsqueeze(-1), drawn, self._noise)
        return self._noise


class PinkNormal:
    """Pink noise, power ∝ 1 / frequency: a sum of processes whose time constants double.

    The processes are first-order autoregressive and start each episode in their stationary
    distribution. Up to the longest time constant, power times frequency stays within a factor of
    1.7. Others draw whole episodes by Fourier transforms instead (Eberhard 2023).

    Equation: x_t = Σ_i y_i,t / √K with y_i,t+1 = a_i y_i,t + √(1 - a_i²) ε, a_i = exp(-2^-i) for i
    from 0 to K - 1, so that the correlation over k steps is the mean of a_i^k.

    Args:
        longest (int): time constant of the slowest process in steps, rounded down to a power of 2.

    Raises:
        ValueError: if longest is not positive.

    Examples:
        >>> pink = PinkNormal(longest=64)
        >>> pink(torch.zeros(4, 2), is_init=torch.ones(4, dtype=torch.bool)).shape
        torch.Size([4, 2])
    """

    def __init__(self, longest: int) -> None:
        check_integer(1, longest=longest)
        constants = 2.0 ** torch.arange(1 + int(math.log2(longest)))
        self._kept = torch.exp(-1 / constants)
        self._parts: Tensor | None = None

    def __call__(self, like: Tensor, is_init: Tensor) -> Tensor:
        """Noise of this step, see :class:`HeldNormal`."""
        kept = self._kept.to(like).view(-1, *[1] * like.ndim)
        drawn = torch.randn((len(kept), *like.shape), dtype=like.dtype, device=like.device)
        if _is_like(self._parts, drawn):
            going_on = kept * self._parts + (1 - kept.square()).sqrt() * drawn
            drawn = torch.where(is_init.unsqueeze(-1), drawn, going_on)
        self._parts = drawn
        return self._parts.sum(0) / math.sqrt(len(kept))


def _is_like(kept: Tensor | None, now: Tensor) -> TypeGuard[Tensor]:
    """Whether noise can go on: not where the simulators, the device or the precision are others."""
    return (
        kept is not None
        and kept.shape == now.shape
        and kept.dtype == now.dtype
        and kept.device == now.device
    )
