"""An update as one compiled graph."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from tensordict.nn import CudaGraphModule

__all__ = ["compiled", "cuda_graph"]


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Trace a function into one graph at its first call, its backward pass included.

    With :func:`torch.autograd.grad` inside the graph nothing has to be kept between a forward and
    a backward half: on CPUs without AVX-512 the masks of rectifiers, kept as booleans, would cost
    as much as a third of the products.

    Examples:
        >>> import torch
        >>> x = torch.ones(3, requires_grad=True)
        >>> slope = compiled(lambda x: torch.autograd.grad(x.square().sum(), x)[0])
        >>> slope(x)  # doctest: +SKIP
        tensor([2., 2., 2.])
    """
    traced = torch.compile(function, fullgraph=True, isolate_recompiles=True)

    @wraps(function)
    def call(*args: Any) -> Any:
        with torch._dynamo.config.patch(trace_autograd_ops=True):
            return traced(*args)

    return call


def cuda_graph(function: Callable[..., Any]) -> Callable[..., Any]:
    """Record what a function of a tensordict does on the GPU and play it back, as one launch."""
    return CudaGraphModule(function, in_keys=[], out_keys=[], warmup=5)
