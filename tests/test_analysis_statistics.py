"""Intervals are deterministic, defined for degenerate data, and have their nominal coverage."""

import math

import numpy as np
import pytest

from torchrl_etl.analysis.statistics import interval, success_interval


def test_interval_has_nominal_coverage():
    rng = np.random.default_rng(0)
    samples = rng.exponential(2.0, size=(60, 30))
    hits = sum(low <= 2.0 <= high for _, low, high in map(interval, samples))
    assert 49 <= hits <= 60  # nominal: 95 % of 60 = 57; a little lower for 30 skewed values


def test_interval_is_deterministic_and_holds_its_mean():
    values = [3.0, 1.0, 4.0, 1.0, 5.0]
    assert interval(values) == interval(values)
    mean, low, high = interval(values)
    assert low < mean < high


def test_interval_of_constants_is_a_point_and_of_one_value_nan():
    assert interval([2.5] * 4) == (2.5, 2.5, 2.5)
    mean, low, high = interval([2.5])
    assert mean == 2.5 and math.isnan(low) and math.isnan(high)


def test_success_interval_is_wilsons():
    # Wilson by hand: centre (p + z²/2n) / (1 + z²/n), half z/(1 + z²/n)·sqrt(p(1-p)/n + z²/4n²)
    n, p, z = 20, 0.4, 1.959964
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    solved = [True] * 8 + [False] * 12
    assert success_interval(solved) == pytest.approx((p, centre - half, centre + half), abs=1e-6)
    assert interval(np.array(solved)) == success_interval(solved)
    assert success_interval([0] * 10).high > 0.2


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: interval([]), "no values"),
        (lambda: interval([1.0, math.nan]), "1 of 2 values are not finite"),
        (lambda: success_interval([0.5, 1.0]), "neither 0 nor 1"),
    ],
)
def test_unusable_values_are_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()
