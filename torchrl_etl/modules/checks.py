"""Argument checks that several modules share."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

__all__ = ["check_choice", "check_positive"]


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise a ``ValueError`` that lists the choices and names the nearest.

    Examples:
        >>> check_choice("stage", "learn", ("explore", "learn", "all"))
        >>> check_choice("stage", "lern", ("explore", "learn", "all"))
        Traceback (most recent call last):
        ...
        ValueError: stage is 'lern'; choose one of explore, learn, all (nearest: learn).
    """
    if value not in choices:
        near = difflib.get_close_matches(str(value), choices, n=1)
        hint = f" (nearest: {near[0]})" if near else ""
        raise ValueError(f"{name} is {value!r}; choose one of {', '.join(choices)}{hint}.")


def check_positive(**sizes: int) -> None:
    """Raise a ``ValueError`` naming the first size that is not a positive integer.

    Examples:
        >>> check_positive(latent_dim=4)
        >>> check_positive(latent_dim=0)
        Traceback (most recent call last):
        ...
        ValueError: latent_dim is 0; it must be a positive integer.
    """
    for name, size in sizes.items():
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise ValueError(f"{name} is {size!r}; it must be a positive integer.")
