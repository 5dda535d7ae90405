"""IQM, probability of improvement and bands against scipy and rliable."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rliable import metrics
from scipy.stats import trim_mean

from tests.sweep_rows import FEW
from torchrl_etl.analysis.bootstrap import iqm, mean_band, probability_of_improvement


def test_iqm_is_the_mean_of_the_middle_half():
    values = [9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0]
    assert iqm([values], repetitions=0).mean == (3 + 4 + 5 + 6) / 4 == trim_mean(values, 0.25)
    # Runs are pooled over tasks, also with unequal numbers of seeds.
    assert iqm([values[:5], values[5:]], repetitions=0).mean == 4.5


def test_iqm_interval_is_deterministic_and_covers_the_true_mean():
    rng = np.random.default_rng(0)
    np.random.seed(5)
    expected = np.random.random()
    np.random.seed(5)
    hits = 0
    for _ in range(25):
        groups = [rng.normal(3.0, 1.0, 12), rng.normal(3.0, 1.0, 9)]
        mean, low, high = iqm(groups, repetitions=100)
        assert low < mean < high
        hits += low <= 3.0 <= high
    assert 19 <= hits <= 25  # nominal: 95 % of 25 = 24; a little lower with some twenty runs
    assert iqm(groups, repetitions=FEW) == iqm(groups, repetitions=FEW)
    assert np.random.random() == expected


def test_iqm_resamples_within_tasks_only():
    """Two tasks far apart without spread: resampling across tasks would give a wide interval."""
    assert iqm([[0.0, 0.0], [100.0, 100.0]], repetitions=FEW) == (50.0, 50.0, 50.0)


def test_one_seed_gets_no_interval():
    for groups in ([[4.0]], [[1.0, 7.0], [4.0]]):
        mean, low, high = iqm(groups, repetitions=FEW)
        assert mean == 4.0 and math.isnan(low) and math.isnan(high)
    assert math.isnan(probability_of_improvement([([1.0, 2.0], [0.0])], repetitions=FEW).low)


def test_probability_of_improvement_by_hand():
    low, high = [1.0, 2.0, 3.0], [4.0, 5.0]
    assert probability_of_improvement([(high, low)], repetitions=FEW) == (1.0, 1.0, 1.0)
    assert probability_of_improvement([(low, low)], repetitions=0).mean == 0.5
    # By hand: 2 beats one of {1, 3} and 3 beats one and ties with one, of 4 pairs; and 0 of 2.
    tied = ([2.0, 3.0], [1.0, 3.0])
    assert probability_of_improvement([tied], repetitions=0).mean == (1 + 1.5) / 4
    both = probability_of_improvement([tied, (low[:1], high)], repetitions=0).mean
    assert both == (2.5 / 4 + 0) / 2


def test_probability_of_improvement_equals_rliables():
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 5, (6, 3)).astype(float), rng.integers(0, 5, (4, 3)).astype(float)
    ours = probability_of_improvement(list(zip(x.T, y.T, strict=True)), repetitions=0).mean
    assert ours == pytest.approx(metrics.probability_of_improvement(x, y))


def test_mean_band_is_an_interval_from_three_seeds_and_the_range_of_two():
    values = np.array([[0.0, 5.0], [1.0, 5.0], [5.0, 5.0]])
    low, high = mean_band(values, repetitions=200)
    assert 0.0 <= low[0] < 2.0 < high[0] < 5.0 + 1e-9
    assert low[1] == high[1] == 5.0
    low, high = mean_band(values[[0, 2]])
    assert (low[0], high[0]) == (0.0, 5.0)
