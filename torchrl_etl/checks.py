"""Checks of arguments. Messages give the value, what is expected and, if known, a fix.

Every message begins with the argument's name, so that :func:`naming` can prefix the section of a
configuration.
"""

from __future__ import annotations

import difflib
import math
import numbers
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypeGuard

from torch import Tensor

__all__ = [
    "check_choice",
    "check_flag",
    "check_integer",
    "check_path",
    "check_real",
    "check_sizes",
    "check_width",
    "choose_one",
    "naming",
    "not_finite",
    "renaming",
]


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise a ``ValueError`` that lists the choices and the nearest one.

    Examples:
        >>> check_choice("stage", "learn", ("explore", "learn", "all"))
        >>> check_choice("stage", "lern", ("explore", "learn", "all"))
        Traceback (most recent call last):
        ...
        ValueError: stage is 'lern'; choose one of explore, learn, all (nearest: learn).
    """
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; {choose_one(value, choices)}.")


def choose_one(value: object, choices: Sequence[str]) -> str:
    """The end of a message about a value that is none of ``choices``.

    Examples:
        >>> choose_one("lern", ("explore", "learn", "all"))
        'choose one of explore, learn, all (nearest: learn)'
    """
    near = difflib.get_close_matches(str(value), choices, n=1)
    return f"choose one of {', '.join(choices)}" + (f" (nearest: {near[0]})" if near else "")


def check_integer(least: int, **values: object) -> None:
    """Raise a ``ValueError`` naming the first value that is not an integer >= ``least``.

    Examples:
        >>> check_integer(2, batch_size=1)
        Traceback (most recent call last):
        ...
        ValueError: batch_size is 1; it must be a whole number, 2 or more.
    """
    for name, value in values.items():
        if not _is_integer(value) or value < least:
            raise ValueError(f"{name} is {value!r}; it must be a whole number, {least} or more.")


def check_path(**values: object) -> None:
    """Raise a ``ValueError`` naming the first value that is neither a path nor ``None``.

    Examples:
        >>> check_path(run="runs/a", out=None)
        >>> check_path(run=["runs/a", "runs/b"])
        Traceback (most recent call last):
        ...
        ValueError: run is ['runs/a', 'runs/b']; it must be one path.
    """
    for name, value in values.items():
        if value is not None and not isinstance(value, str):
            raise ValueError(f"{name} is {value!r}; it must be one path.")


def check_real(interval: str, **values: object) -> None:
    """Raise a ``ValueError`` naming the first value that is not a number in the interval.

    Examples:
        >>> check_real("[0, 1)", gamma=0.9, tau=0)
        >>> check_real("[0, 1)", gamma=1.0)
        Traceback (most recent call last):
        ...
        ValueError: gamma is 1.0; it must be a number in [0, 1).
        >>> check_real("(0, inf)", lr=float("nan"))
        Traceback (most recent call last):
        ...
        ValueError: lr is nan; it must be a number above 0.
    """
    low, high = map(float, interval[1:-1].split(","))
    for name, value in values.items():
        within = (
            _is_real(value)
            and math.isfinite(value)
            and (low <= value if interval[0] == "[" else low < value)
            and (value <= high if interval[-1] == "]" else value < high)
        )
        if not within:
            words = {"(0, inf)": "above 0", "[0, inf)": "0 or more"}.get(interval, f"in {interval}")
            raise ValueError(f"{name} is {value!r}; it must be a number {words}.")


def check_sizes(**values: object) -> None:
    """Raise a ``ValueError`` naming the first value that is not a list of positive integers.

    Examples:
        >>> check_sizes(hidden=[64, 0])
        Traceback (most recent call last):
        ...
        ValueError: hidden is [64, 0]; it must be a list of whole numbers above 0.
    """
    for name, value in values.items():
        if (
            not isinstance(value, Sequence)
            or isinstance(value, str)
            or not value
            or not all(_is_integer(size) and size > 0 for size in value)
        ):
            raise ValueError(f"{name} is {value!r}; it must be a list of whole numbers above 0.")


def check_width(size: int, **tensors: Tensor) -> None:
    """Raise a ``ValueError`` naming the first tensor whose last size is not ``size``.

    A last size of 1 would otherwise be broadcast.

    Examples:
        >>> import torch
        >>> check_width(4, synergy=torch.zeros(2, 1))
        Traceback (most recent call last):
        ...
        ValueError: synergy has shape [2, 1]; its last size must be 4.
    """
    for name, tensor in tensors.items():
        if tensor.shape[-1:] != (size,):
            raise ValueError(
                f"{name} has shape {list(tensor.shape)}; its last size must be {size}."
            )


@contextmanager
def naming(section: str) -> Iterator[None]:
    """Prefix the errors of argument checks with a section of the configuration.

    Args:
        section (str): its name. Nested calls of ``naming`` prepend theirs.

    Examples:
        >>> with naming("learn.sac"):
        ...     check_real("(0, inf)", lr=0)
        Traceback (most recent call last):
        ...
        ValueError: learn.sac.lr is 0; it must be a number above 0.
    """
    try:
        yield
    except ValueError as error:
        error.args = (f"{section}.{error}",)  # a new one may take other arguments, as JSON's does
        raise


@contextmanager
def renaming(**names: str) -> Iterator[None]:
    """Replace argument names in the errors of checks by the names that the caller uses.

    Examples:
        >>> with renaming(share="relabel"):
        ...     check_real("[0, 1]", share=2)
        Traceback (most recent call last):
        ...
        ValueError: relabel is 2; it must be a number in [0, 1].
    """
    try:
        yield
    except ValueError as error:
        name, _, said = str(error).partition(" ")
        if name in names:
            error.args = (f"{names[name]} {said}",)
        raise


def check_flag(**values: object) -> None:
    """Raise a ``ValueError`` naming the first value that is neither true nor false.

    Examples:
        >>> check_flag(pictures="no")
        Traceback (most recent call last):
        ...
        ValueError: pictures is 'no'; it must be true or false.
    """
    for name, value in values.items():
        if not isinstance(value, bool):
            raise ValueError(f"{name} is {value!r}; it must be true or false.")


def _is_integer(value: object) -> TypeGuard[int]:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def _is_real(value: object) -> TypeGuard[float]:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)  # NumPy's scalars, too


def not_finite(state: Mapping[str, Tensor]) -> str | None:
    """The key of the first entry with a NaN or an infinity, if any.

    Examples:
        >>> import torch
        >>> not_finite({"weight": torch.ones(2), "bias": torch.tensor([1.0, torch.nan])})
        'bias'
    """
    return next((key for key, value in state.items() if not value.isfinite().all()), None)
