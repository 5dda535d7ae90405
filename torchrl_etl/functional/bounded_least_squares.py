"""Least squares within a box, for coefficients that a policy can output."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["bounded_least_squares"]

_SWEEPS = 30


def bounded_least_squares(weight: Tensor, target: Tensor) -> Tensor:
    r"""Minimize :math:`\|W x - t\|` over :math:`x \in [-1, 1]^d`, by coordinate descent.

    Clamping the unbounded solution would be far from the minimum where columns of W are nearly
    parallel: their coefficients are then large and cancel. Where the unbounded solution is inside
    the box, it is returned. Elsewhere, 30 rounds over the coordinates come close to the minimum.
    These cases are told apart in Python, so that it fails under ``torch.vmap``.

    Args:
        weight (Tensor): W [n, d].
        target (Tensor): t [*, n].

    Returns:
        Tensor: x [*, d] in [-1, 1], of the target's dtype. Half precision is solved in single.

    Examples:
        >>> import torch
        >>> nearly_parallel = torch.tensor([[1.0, 1.0], [0.0, 0.01]])
        >>> bounded_least_squares(nearly_parallel, torch.tensor([0.5, 0.1]))
        tensor([-0.5000,  1.0000])
    """
    dtype = target.dtype
    weight, target = (
        each.to(torch.promote_types(dtype, torch.float32)) for each in (weight, target)
    )
    x = target @ weight.pinverse().mT
    outside = (x.abs() > 1).any(-1)
    if not outside.any():
        return x.to(dtype)
    found, gram, moment = x[outside].clamp(-1, 1), weight.mT @ weight, target[outside] @ weight
    curvature = gram.diagonal().clamp_min(torch.finfo(gram.dtype).tiny)
    for _ in range(_SWEEPS):
        for i in range(len(gram)):
            slope = found @ gram[i] - moment[..., i]
            found[..., i] = (found[..., i] - slope / curvature[i]).clamp(-1, 1)
    x[outside] = found
    return x.to(dtype)
