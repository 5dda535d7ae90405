"""Argument checks that several modules share."""

from __future__ import annotations

__all__ = ["check_positive"]


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
