"""Values as categorical distributions over a grid of returns (Bellemare 2017)."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["categorical_cross_entropy", "categorical_mean", "project_categorical"]


def categorical_mean(logits: Tensor, support: Tensor) -> Tensor:
    """Expected return [*] of the distributions with these logits [*, K] on a support [K].

    Examples:
        >>> import torch
        >>> categorical_mean(torch.zeros(3), torch.tensor([-1.0, 0.0, 4.0]))
        tensor(1.)
    """
    return logits.softmax(-1) @ support


def project_categorical(probabilities: Tensor, atoms: Tensor, support: Tensor) -> Tensor:
    """Project distributions on atoms [*, K] onto the support [M]; returns probabilities [*, M].

    Each atom is clipped to the support. Its probability is split between its two neighbors in
    proportion to nearness, which keeps the mean unless atoms are clipped.

    Args:
        probabilities (Tensor): of the atoms, [*, K].
        atoms (Tensor): positions of the atoms, [*, K].
        support (Tensor): evenly spaced, ascending, [M].

    Examples:
        >>> import torch
        >>> support = torch.tensor([0.0, 1.0, 2.0])
        >>> project_categorical(torch.tensor([0.5, 0.5]), torch.tensor([0.25, 9.0]), support)
        tensor([0.3750, 0.1250, 0.5000])
    """
    last = support.shape[-1] - 1
    spacing = (support[-1] - support[0]) / last
    position = ((atoms - support[0]) / spacing).clamp(0, last)
    below = position.floor().clamp(max=last - 1)
    share = position - below
    index = below.long()
    projected = torch.zeros(
        (*probabilities.shape[:-1], last + 1),
        dtype=probabilities.dtype,
        device=probabilities.device,
    )
    projected = projected.scatter_add(-1, index, probabilities * (1 - share))
    return projected.scatter_add(-1, index + 1, probabilities * share)


def categorical_cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    """-Σ target ln softmax(logits), [*], for logits and target probabilities [*, K].

    Examples:
        >>> import torch
        >>> round(categorical_cross_entropy(torch.zeros(2), torch.tensor([0.5, 0.5])).item(), 3)
        0.693
    """
    return -(target * logits.log_softmax(-1)).sum(-1)
