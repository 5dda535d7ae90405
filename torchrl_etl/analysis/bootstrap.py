"""Interquartile mean and probability of improvement, with stratified bootstrap intervals.

The estimators are from Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (2021), and the intervals from the authors' library, rliable. Seeds are resampled within
each task; tasks are not resampled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike

from torchrl_etl.analysis.statistics import Interval
from torchrl_etl.extras import extra

__all__ = ["iqm", "mean_band", "probability_of_improvement"]


def iqm(groups: Sequence[ArrayLike], *, repetitions: int = 2000) -> Interval:
    """Interquartile mean of the runs of all tasks, with its stratified bootstrap 95 % interval.

    ``groups`` has one array per task, with one number per seed. The bounds are NaN if a task has
    only one seed, or if ``repetitions``, the number of resamples, is 0.

    Examples:
        >>> iqm([[1.0, 2.0, 3.0, 100.0]], repetitions=50).mean
        2.5
    """
    arrays = [np.asarray(group, float) for group in groups]
    return _interval(_pooled_iqm, arrays, repetitions=repetitions)


def probability_of_improvement(
    pairs: Sequence[tuple[ArrayLike, ArrayLike]], *, repetitions: int = 2000
) -> Interval:
    """Probability that a run of method X beats a run of method Y on a task, averaged over tasks.

    ``pairs`` has one pair (x, y) per task, with one number per seed. A tie counts one half. The
    bounds are NaN in the same cases as for :func:`iqm`.

    Equation:
        1/T Σ_t 1/(N_t K_t) Σ_i Σ_j (1[x_ti > y_tj] + ½ 1[x_ti = y_tj]). rliable computes the same
        with SciPy's Mann-Whitney test, whose p-value would take most of the time here.

    Examples:
        >>> probability_of_improvement([([1.0, 3.0], [2.0, 2.0])], repetitions=0).mean
        0.5
    """
    groups = [np.asarray(group, float) for pair in pairs for group in pair]
    return _interval(_improvement, groups, repetitions=repetitions)


def mean_band(values: np.ndarray, *, repetitions: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of a band around the mean over seeds of values [seeds, evaluations].

    For three or more seeds, the percentile bootstrap's 95 % interval; for fewer, the smallest and
    largest value.

    Examples:
        >>> [end.tolist() for end in mean_band(np.array([[1.0, 2.0], [3.0, 2.0]]))]
        [[1.0, 2.0], [3.0, 2.0]]
    """
    if len(values) < 3:
        return values.min(axis=0), values.max(axis=0)
    with extra("statistics"):
        from scipy.stats import bootstrap
    ends = bootstrap(
        (values,),
        np.mean,
        axis=0,
        n_resamples=repetitions,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return ends.low, ends.high


def _pooled_iqm(*groups: np.ndarray) -> np.ndarray:
    with extra("statistics"):
        from rliable import metrics
    return np.array([metrics.aggregate_iqm(np.concatenate(groups))])


def _improvement(*groups: np.ndarray) -> np.ndarray:
    """Mean probability of improvement; groups alternate between methods, task by task."""
    pairs = zip(groups[::2], groups[1::2], strict=True)
    # The mean sign of all differences lies in [-1, 1], a tie at 0.
    wins = [0.5 + 0.5 * np.sign(x.ravel()[:, None] - y.ravel()).mean() for x, y in pairs]
    return np.array([np.mean(wins)])


def _interval(
    statistic: Callable[..., np.ndarray], groups: Sequence[np.ndarray], *, repetitions: int
) -> Interval:
    point = float(statistic(*groups)[0])
    if repetitions == 0 or min(map(len, groups)) < 2:
        return Interval(point, math.nan, math.nan)
    with extra("statistics"):
        from rliable import library
    # One array per task rather than one matrix, since numbers of seeds may differ.
    scores = [group[:, None] for group in groups]
    with _seeded():
        _, ends = library.get_interval_estimates({"": scores}, statistic, reps=repetitions)
    low, high = np.ravel(ends[""]).tolist()
    return Interval(point, low, high)


@contextmanager
def _seeded() -> Iterator[None]:
    """Seed NumPy's global generator, which rliable uses, and restore it afterwards."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)
