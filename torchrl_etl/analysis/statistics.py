"""Confidence intervals for returns and success rates."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from torchrl_etl.extras import extra

__all__ = ["Interval", "interval", "success_interval"]

_CONFIDENCE = 0.95

# Elements resampled at once, which limits the bootstrap of 10,000 episodes to tens of megabytes.
_BATCH_ELEMENTS = 4_000_000


class Interval(NamedTuple):
    """A mean and the bounds of its 95 % confidence interval."""

    mean: float
    low: float
    high: float


def interval(values: ArrayLike) -> Interval:
    """Mean of ``values`` with a 95 % bootstrap confidence interval.

    The interval is bias-corrected and accelerated (BCa), or the percentile interval if BCa is
    undefined, as for constant data. Booleans are passed to :func:`success_interval`. Resampling
    is seeded: the same values give the same interval.

    Args:
        values (array-like): independent numbers, such as one return per seed.

    Returns:
        Interval: mean, low, high. For a single value, low and high are NaN.

    Raises:
        ValueError: if there are no values or one is not finite.

    Examples:
        >>> interval([3.0, 3.0, 3.0])
        Interval(mean=3.0, low=3.0, high=3.0)
        >>> mean, low, high = interval([10.0, 12.0, 9.0, 15.0, 11.0])
        >>> mean, low < mean < high
        (11.4, True)
    """
    array = _checked(values)
    if array.dtype == bool:
        return success_interval(array)
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(
            f"{int((~np.isfinite(array)).sum())} of {array.size} values are not finite; an "
            "interval needs finite numbers. Drop the failed runs and report how many there were."
        )
    mean = float(array.mean())
    if array.size == 1:
        return Interval(mean, float("nan"), float("nan"))
    with extra("statistics"):
        from scipy.stats import DegenerateDataWarning, bootstrap
    for method in ("BCa", "percentile"):
        with warnings.catch_warnings():
            # A degenerate BCa divides zero by zero; the resulting NaN is handled below.
            warnings.simplefilter("ignore", DegenerateDataWarning)
            warnings.simplefilter("ignore", RuntimeWarning)
            ends = bootstrap(
                (array,),
                np.mean,
                confidence_level=_CONFIDENCE,
                method=method,
                batch=max(1, _BATCH_ELEMENTS // array.size),
                rng=np.random.default_rng(0),
            ).confidence_interval
        if np.isfinite(ends).all():
            break
    return Interval(mean, float(ends.low), float(ends.high))


def success_interval(solved: Sequence[bool] | np.ndarray) -> Interval:
    """Share of solved episodes with its 95 % Wilson score interval.

    Unlike a bootstrap interval, it has a sensible width if all episodes or none were solved.

    Args:
        solved (sequence of bool): one outcome per episode, also as 0 and 1.

    Raises:
        ValueError: if there are no outcomes or one is neither 0 nor 1.

    Examples:
        >>> share, low, high = success_interval([True] * 10)
        >>> share, round(low, 3), high
        (1.0, 0.722, 1.0)
    """
    array = _checked(solved)
    if not np.isin(array, (0, 1)).all():
        raise ValueError(
            "Some outcomes are neither 0 nor 1; pass one boolean per episode, or use interval() "
            "for a mean of other numbers."
        )
    with extra("statistics"):
        from scipy.stats import binomtest
    count = int(array.sum())
    ends = binomtest(count, array.size).proportion_ci(_CONFIDENCE, method="wilson")
    return Interval(count / array.size, float(ends.low), float(ends.high))


def _checked(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values).ravel()
    if array.size == 0:
        raise ValueError("There are no values to average; pass at least one.")
    return array
