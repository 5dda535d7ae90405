"""Unit-norm rows of linear layers."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

__all__ = ["normalize_rows"]


@torch.no_grad()
def normalize_rows(weights: Iterable[Tensor]) -> None:
    """Rescale every row of these weights [*, out, in] to unit length, in place.

    Weights that grow make the learning rate relatively smaller. Rescaling after every optimizer
    step prevents that, and keeps a tanh actor from saturating (FlashSAC, 2026; Lyle 2024).

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
