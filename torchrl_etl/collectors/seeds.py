"""Seeds of what is collected for training."""

from __future__ import annotations

__all__ = ["training_seed"]


def training_seed(seed: int, offset: int) -> int:
    """A seed for the part of a run that ``offset`` names.

    It has its highest bit set, which no evaluation seed has.

    Examples:
        >>> training_seed(0, 0) == 2**30
        True
        >>> training_seed(1, 5) - training_seed(1, 0)
        5
    """
    return 2**30 + (seed * 1_000_003 + offset) % 2**30
