"""A sum that stays within its bounds: a residual on a bounded action."""

from __future__ import annotations

from torch import Tensor

__all__ = ["tanh_sum", "tanh_sum_log_slope"]


def tanh_sum(x: Tensor, y: Tensor) -> Tensor:
    r"""Add before the bounds: :math:`\tanh(\tanh^{-1} x + \tanh^{-1} y) = (x + y) / (1 + xy)`.

    For every x it maps y from (-1, 1) onto (-1, 1), so that no y is without effect. A sum that is
    clamped to its bounds has no gradient beyond them.

    Args:
        x, y (Tensor): in [-1, 1], not opposite ends of it, broadcastable to ``[*]``.

    Returns:
        Tensor: in [-1, 1], ``[*]``.

    Examples:
        >>> import torch
        >>> tanh_sum(torch.tensor([0.0, 0.5, 0.9]), torch.tensor([0.5, 0.5, -0.9]))
        tensor([0.5000, 0.8000, 0.0000])
    """
    above, below = _sides(x, y)
    return (above - below) / (above + below)


def tanh_sum_log_slope(x: Tensor, y: Tensor) -> Tensor:
    r"""How far :func:`tanh_sum` moves with y, :math:`\ln \partial / \partial y`.

    .. math:: \ln \frac{1 - x^2}{(1 + xy)^2}

    Args:
        x (Tensor): in (-1, 1), broadcastable to ``[*]``.
        y (Tensor): in [-1, 1], broadcastable to ``[*]``.

    Returns:
        Tensor: ``[*]``; zero where x is.

    Examples:
        >>> import torch
        >>> tanh_sum_log_slope(torch.tensor([0.0, 0.5]), torch.tensor([0.5, 0.0]))  # 0, ln 0.75
        tensor([ 0.0000, -0.2877])
    """
    above, below = _sides(x, y)
    return ((1 - x) * (1 + x)).log() - 2 * ((above + below) / 2).log()


def _sides(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """(1 + x)(1 + y) and (1 - x)(1 - y): x + y and 1 + xy are halves of their difference and sum.

    None of these is negative, so that rounding leads to no sum beyond the bounds.
    """
    return (1 + x) * (1 + y), (1 - x) * (1 - y)
