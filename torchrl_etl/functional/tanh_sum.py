"""A sum that stays within bounds, to add a residual to a bounded action."""

from __future__ import annotations

from torch import Tensor

__all__ = ["tanh_sum", "tanh_sum_log_slope"]


def tanh_sum(x: Tensor, y: Tensor) -> Tensor:
    r"""Add before the bounds: :math:`\tanh(\tanh^{-1} x + \tanh^{-1} y) = (x + y) / (1 + xy)`.

    For every x in (-1, 1) it maps y from (-1, 1) onto (-1, 1), so every y has an effect. A sum
    clamped to its bounds would have no gradient beyond them.

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
    r"""Log of the derivative of :func:`tanh_sum` by y, :math:`\ln \partial / \partial y`.

    .. math:: \ln \frac{1 - x^2}{(1 + xy)^2}

    Args:
        x (Tensor): in (-1, 1), broadcastable to ``[*]``.
        y (Tensor): in [-1, 1], broadcastable to ``[*]``.

    Returns:
        Tensor: ``[*]``; zero where x is zero.

    Examples:
        >>> import torch
        >>> tanh_sum_log_slope(torch.tensor([0.0, 0.5]), torch.tensor([0.5, 0.0]))  # 0, ln 0.75
        tensor([ 0.0000, -0.2877])
    """
    above, below = _sides(x, y)
    return ((1 - x) * (1 + x)).log() - 2 * ((above + below) / 2).log()


def _sides(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """(1 + x)(1 + y) and (1 - x)(1 - y): half their difference is x + y, half their sum 1 + xy.

    Neither is negative, so rounding cannot move the result beyond the bounds.
    """
    return (1 + x) * (1 + y), (1 - x) * (1 - y)
