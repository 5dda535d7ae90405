"""Seeded inputs in double precision, and gradient checks by finite differences."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd import gradcheck


def doubles(*shape: int, seed: int = 0, grad: bool = False) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_(grad)


def positive(*shape: int, seed: int = 0) -> Tensor:
    return doubles(*shape, seed=seed).exp()


def gradients_match(function: Callable[..., Tensor], *shapes: tuple[int, ...]) -> bool:
    """Whether gradients of a function of inputs of these shapes equal finite differences."""
    inputs = [doubles(*shape, seed=i, grad=True) for i, shape in enumerate(shapes)]
    return gradcheck(function, inputs)
