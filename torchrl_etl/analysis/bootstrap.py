"""Interquartile means of runs and how often one beats another, with bootstrap intervals.

The estimators are those of Agarwal et al., "Deep reinforcement learning at the edge of the
statistical precipice" (2021), and the intervals come from the authors' library, rliable: seeds are
resampled within each task, so tasks stay as they are.
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

    ``groups`` have for each task one number per seed. The ends are NaN where a task has one seed,
    which says nothing about its spread, and without ``repetitions``, which are resamples.

    Examples:
        >>> iqm([[1.0, 2.0, 3.0, 100.0]], repetitions=50).mean
        2.5
    """
    arrays = [np.asarray(group, float) for group in groups]
    return _interval(_pooled_iqm, arrays, repetitions=repetitions)


def probability_of_improvement(
    pairs: Sequence[tuple[ArrayLike, ArrayLike]], *, repetitions: int = 2000
) -> Interval:
    """How often a run of one method beats a run of another on the same task, mean over tasks.

    ``pairs`` have for each task the one's and the other's numbers, one per seed; a tie counts one
    half. The ends are NaN as those of :func:`iqm`.

    Equation:
        1/T Σ_t 1/(N_t K_t) Σ_i Σ_j (1[x_ti > y_tj] + ½ 1[x_ti = y_tj]); what rliable computes by
        way of the Mann-Whitney statistic, without its test, which would be most of the time here.

    Examples:
        >>> probability_of_improvement([([1.0, 3.0], [2.0, 2.0])], repetitions=0).mean
        0.5
    """
    groups = [np.asarray(group, float) for pair in pairs for group in pair]
    return _interval(_improvement, groups, repetitions=repetitions)


def mean_band(values: np.ndarray, *, repetitions: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Ends of a band around the mean over seeds of values [seeds, evaluations].

    From three seeds up it is the percentile bootstrap's 95 % interval; of two seeds, or of one,
    smallest and largest value.

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
    """Groups alternate between the one's runs and the other's, task by task."""
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
    # One array per task rather than one matrix: numbers of seeds may differ.
    scores = [group[:, None] for group in groups]
    with _seeded():
        _, ends = library.get_interval_estimates({"": scores}, statistic, reps=repetitions)
    low, high = np.ravel(ends[""]).tolist()
    return Interval(point, low, high)


@contextmanager
def _seeded() -> Iterator[None]:
    """rliable resamples with NumPy's global generator: seed it, and leave it as it was."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)
