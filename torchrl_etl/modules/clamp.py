"""Clamp that lets a parameter return from its bounds."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

__all__ = ["Clamp"]


class Clamp(torch.autograd.Function):
    """``value.clamp(low, high)`` that keeps the gradient where descent leads back inside.

    Examples:
        >>> value = torch.tensor([-1.0, 0.5, 2.0], requires_grad=True)
        >>> Clamp.apply(value, 0.0, 1.0).sum().backward()  # descent would lower all three
        >>> value.grad
        tensor([0., 1., 1.])
    """

    generate_vmap_rule = True  # forward and backward use only operations that torch.vmap supports

    @staticmethod
    def forward(value: Tensor, low: float, high: float) -> Tensor:
        return value.clamp(low, high)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, float, float], output: Tensor) -> None:
        value, *ctx.bounds = inputs
        ctx.save_for_backward(value)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (value,), (low, high) = ctx.saved_tensors, ctx.bounds
        outward = ((value <= low) & (gradient > 0)) | ((value >= high) & (gradient < 0))
        return gradient.masked_fill(outward, 0), None, None
