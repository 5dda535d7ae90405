"""Checks and converts recorded actions and action bounds."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

__all__ = ["LEAST_REACH", "OVERSHOOT", "as_actions", "as_bounds", "bounds_of"]

# Recordings overshoot their bounds a little: filters ring, and estimates are noisy.
OVERSHOOT = 0.1
# Of the way from the lower bound to the upper: closer to the lower one decoders are flat.
LEAST_REACH = 0.05


def as_actions(
    actions: Tensor | np.ndarray | Sequence[Any], *, low: Tensor, high: Tensor, min_rows: int = 0
) -> Tensor:
    """Convert recorded actions to a tensor with the dtype and device of the bounds.

    Integers, double precision, NumPy arrays and lists are accepted.

    Args:
        actions (array): [*, n], in action units.

    Keyword Args:
        low, high (Tensor): action bounds [n]. Values may exceed them by a tenth of the range.
        min_rows (int): if above 0, require this many rows, return [N, n], and warn if all rows
            are equal or so close to the lower bound that their unit must differ from the bounds'.
            Default: 0.

    Raises:
        TypeError: if the actions are not real numbers.
        ValueError: if the last size is not n, a value is masked, not finite or far outside the
            bounds, or there are too few rows.

    Examples:
        >>> import numpy as np
        >>> low, high = torch.zeros(3), torch.ones(3)
        >>> as_actions(np.full((2, 3), 0.5), low=low, high=high).dtype
        torch.float32
        >>> as_actions(np.ones((2, 4)), low=low, high=high)
        Traceback (most recent call last):
        ...
        ValueError: The actions have shape (2, 4), but there are 3 actuators; pass an array [N, 3].
    """
    if np.ma.is_masked(actions):
        raise ValueError("The actions have masked values; leave their rows out, or fill them.")
    try:
        found = actions if isinstance(actions, Tensor) else _from_array(actions)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(
            f"The actions are a {type(actions).__name__}, not an array of real numbers; pass "
            f"an array [N, {len(low)}]."
        ) from error
    if found.is_complex():
        raise TypeError(
            f"The actions are {found.dtype}; pass an array [N, {len(low)}] of real numbers."
        )
    if found.ndim == 0 or found.shape[-1] != len(low):
        raise ValueError(
            f"The actions have shape {tuple(found.shape)}, but there are {len(low)} actuators; "
            f"pass an array [N, {len(low)}]."
        )
    found = found.to(low)
    rows = found.detach().reshape(-1, len(low))
    _check_values(rows, low, high)
    if not min_rows:
        return found
    if len(rows) < min_rows:
        raise ValueError(
            f"The actions have {len(rows)} row(s), too few to find synergies; pass at least "
            f"{min_rows} different actions, [N, {len(low)}]."
        )
    if bool((rows == rows[0]).all()):
        warnings.warn(
            f"All {len(rows)} actions are the same, so they have no synergies.",
            stacklevel=3,
        )
    elif (reach := float(((rows - low) / (high - low)).max())) < LEAST_REACH:
        warnings.warn(
            f"The actions reach only {reach:.2g} of the way from their lower to their upper bound, "
            "too little for a decoder to reproduce; pass the model low= and high= in the units of "
            "the actions.",
            stacklevel=3,
        )
    return rows


def as_bounds(low: Any, high: Any, action_dim: int) -> tuple[Tensor, Tensor]:
    """Copies of both action bounds, [n] each, in single precision.

    Args:
        low, high (float, sequence of float or Tensor): one number, or one for each actuator.
        action_dim (int): number n of actuators.

    Raises:
        ValueError: if a bound has another shape than [] or [n], or a lower bound is not finite and
            below its upper bound.

    Examples:
        >>> as_bounds(0.0, [1.0, 2.0], 2)
        (tensor([0., 0.]), tensor([1., 2.]))
    """
    low, high = (torch.as_tensor(bound, dtype=torch.float32).detach() for bound in (low, high))
    for bound in (low, high):
        if bound.shape not in ((), (action_dim,)):
            raise ValueError(
                f"An action bound has shape {tuple(bound.shape)} but there are {action_dim} "
                "actuators; pass one number, or one for each."
            )
    low, high = low.expand(action_dim).clone(), high.expand(action_dim).clone()
    if not ((high - low).isfinite() & (low < high)).all():
        raise ValueError(
            f"The action bounds are low={low.tolist()} and high={high.tolist()}; every lower "
            "bound must be finite and below its upper bound. Take them from the environment's "
            "action spec."
        )
    return low, high


def bounds_of(action_spec: TensorSpec) -> tuple[Tensor, Tensor]:
    """Lower and upper bounds of a ``Bounded`` leaf.

    Raises:
        ValueError: if the spec is not ``Bounded``, or a bound is not finite or not below its upper
            bound.
    """
    if isinstance(action_spec, Bounded):
        low, high = action_spec.space.low, action_spec.space.high
        if ((high - low).isfinite() & (low < high)).all():
            return low, high
    raise ValueError(
        f"The action spec is a {type(action_spec).__name__} of shape {tuple(action_spec.shape)} "
        "without finite, ascending bounds; pass the bounded leaf of one environment, such as "
        "env.action_spec_unbatched."
    )


def _from_array(actions: np.ndarray | Sequence[Any]) -> Tensor:
    array = np.asarray(actions)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"Its dtype is {array.dtype}.")
    # Copy: torch has no negative strides, foreign byte orders or extended precision.
    return torch.from_numpy(np.array(array, np.float64, order="C"))


def _check_values(rows: Tensor, low: Tensor, high: Tensor) -> None:
    broken = ~torch.isfinite(rows).all(-1)
    if broken.any():
        raise ValueError(
            f"The actions have NaN or infinity in {int(broken.sum())} of {len(rows)} rows, the "
            f"first in row {int(broken.nonzero()[0])}; leave these rows out."
        )
    margin = OVERSHOOT * (high - low)
    if ((rows < low - margin) | (rows > high + margin)).any():
        raise ValueError(
            f"The actions lie between {rows.min():g} and {rows.max():g}, but the bounds are "
            f"[{low.min():g}, {high.max():g}]; scale the actions to these bounds, or pass the "
            "model low= and high= in the units of the actions."
        )
