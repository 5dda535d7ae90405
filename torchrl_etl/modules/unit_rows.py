"""Linear layers on the unit sphere."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

__all__ = ["normalize_rows"]


@torch.no_grad()
def normalize_rows(weights: Iterable[Tensor]) -> None:
    """Bring every row of these weights [*, out, in] back to unit length, in place.

    Done after every optimizer step, it keeps the learning rate in proportion to the weights, which
    otherwise grow, and a tanh actor out of its flat ends (FlashSAC, 2026; Lyle 2024).

    Examples:
        >>> import torch
        >>> weight = torch.tensor([[3.0, 4.0], [0.0, 2.0]])
        >>> normalize_rows([weight])
        >>> weight
        tensor([[0.6000, 0.8000],
                [0.0000, 1.0000]])
    """
    weights = list(weights)
    if not weights:
        return
    lengths = [weight.norm(dim=-1, keepdim=True).clamp_min(1e-8) for weight in weights]
    torch._foreach_div_(weights, lengths)
