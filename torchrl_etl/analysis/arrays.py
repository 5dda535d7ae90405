"""Conversion of tensors and arrays to float64 arrays, the type of all computations here."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

__all__ = ["as_array", "as_matrix"]


def as_array(values: Tensor | ArrayLike) -> np.ndarray:
    """Numbers of any shape, on any device, as a float64 array.

    Examples:
        >>> as_array([1, 2])
        array([1., 2.])
    """
    if isinstance(values, Tensor):
        values = values.detach().cpu().double().numpy()
    return np.asarray(values, dtype=np.float64)


def as_matrix(values: Tensor | ArrayLike, name: str) -> np.ndarray:
    """Finite numbers [*, n] as a float64 array [N, n]; ``name`` is used in error messages.

    Examples:
        >>> import torch
        >>> as_matrix(torch.zeros(2, 3, 4), "actions").shape
        (6, 4)
    """
    array = as_array(values)
    if array.ndim < 2 or array.size == 0:
        raise ValueError(
            f"{name} have shape {array.shape}; at least one action is needed, as an array [*, n]."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"{name} hold numbers that are not finite; drop those rows first.")
    return array.reshape(-1, array.shape[-1])
