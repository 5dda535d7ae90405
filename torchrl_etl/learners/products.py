"""Matrix products of a compiled update through oneDNN where it is faster than MKL.

On AMD processors MKL, PyTorch's default (torch 2.13), does not use AVX-512 and runs at half the
speed of oneDNN. On Intel's it does, and is faster. PyTorch includes oneDNN but has no public
function for it. Where oneDNN is used, products with a single row or column become sums.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

__all__ = ["by_onednn", "faster_products", "is_amd", "multiply"]

_SMALLEST = 16  # of m, k and n each; below, MKL is faster


def multiply(a: Tensor, b: Tensor, bias: Tensor | None) -> Tensor:
    """Product of a [m, k] and b [k, n] plus the bias [n], as :func:`torch.addmm`."""
    return torch.ops.mkldnn._linear_pointwise(a, b.t(), bias, "none", [], "")


product = torch.library.custom_op("torchrl_etl::product", multiply, mutates_args=())


@product.register_fake
def _(a: Tensor, b: Tensor, bias: Tensor | None) -> Tensor:
    return a.new_empty(a.shape[0], b.shape[1])


@cache
def faster_products() -> dict[Any, Callable[..., Any]]:
    """Decompositions of products for :func:`~torch.fx.experimental.proxy_tensor.make_fx`.

    Empty where oneDNN is not known to be faster: it is with AVX-512 on AMD's processors.
    """
    avx512 = torch.backends.cpu.get_cpu_capability() == "AVX512"
    if not (avx512 and torch.backends.mkldnn.is_available() and is_amd()):
        return {}
    from torch._inductor.ir import ExternKernel
    from torch._inductor.lowering import fallback_handler, permute, register_lowering

    linear = torch.ops.mkldnn._linear_pointwise.default
    # Inductor's own lowering of this operation requires constant weights.
    call = fallback_handler(linear, add_to_fallback_set=False)

    @register_lowering(torch.ops.torchrl_etl.product.default, type_promotion_kind=None)
    def lower(a: Any, b: Any, bias: Any) -> Any:
        # Let the producing kernel write it contiguously; oneDNN would copy it, which is slower.
        return call(ExternKernel.require_contiguous(a), permute(b, [1, 0]), bias, "none", [], "")

    return {torch.ops.aten.mm.default: _mm, torch.ops.aten.addmm.default: _addmm}


def is_amd(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether the processor is AMD's, as far as the system tells."""
    try:
        text = cpuinfo.read_text(encoding="utf-8")
    except OSError:
        text = platform.processor()  # names the vendor on Windows
    return "AuthenticAMD" in text


def by_onednn(a: Tensor, b: Tensor) -> bool:
    """Whether oneDNN is faster for this product, if :func:`faster_products` is not empty."""
    plain = a.dtype == torch.float32 and a.device.type == "cpu"
    return plain and min(*a.shape, b.shape[1]) >= _SMALLEST


def _mm(a: Tensor, b: Tensor) -> Tensor:
    if by_onednn(a, b):
        return torch.ops.torchrl_etl.product(a, _dense(b), None)
    return _as_sum(a, b)


def _addmm(bias: Tensor, a: Tensor, b: Tensor, *, beta: float = 1, alpha: float = 1) -> Tensor:
    if beta != 1 or alpha != 1 or bias.shape != b.shape[1:]:
        return NotImplemented
    if by_onednn(a, b):
        # oneDNN ignores the strides of a bias.
        return torch.ops.torchrl_etl.product(a, _dense(b), bias.contiguous())
    total = _as_sum(a, b)
    return total if total is NotImplemented else bias + total


def _as_sum(a: Tensor, b: Tensor) -> Tensor:
    """A product with one row, one column or one inner index, written as a sum so that it fuses with
    neighboring kernels; a critic's single output and its gradients are such products."""
    if a.device.type == "cpu" and a.dtype.is_floating_point:
        if a.shape[1] == 1:
            return a * b
        if b.shape[1] == 1:
            return (a * b.t()).sum(1, keepdim=True)
        if a.shape[0] == 1:
            return (a.t() * b).sum(0, keepdim=True)
    return NotImplemented


def _dense(b: Tensor) -> Tensor:
    """Copy a column slice of a larger matrix: oneDNN has no kernel for it and takes a thousand
    times as long."""
    return b if b.is_contiguous() or b.t().is_contiguous() else b.contiguous()
