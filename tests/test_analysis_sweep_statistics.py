"""Comparisons at an equal number of frames: no fake interval, no borrowed number."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rliable import metrics
from scipy.stats import trim_mean

from tests.sweep_rows import FEW, run, sweep
from torchrl_etl.analysis.sweep_statistics import (
    Scale,
    common_budget,
    compare,
    iqm,
    mean_band,
    normalize,
    overall,
    probability_of_improvement,
)


def test_iqm_is_the_mean_of_the_middle_half():
    values = [9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0]
    assert iqm([values], repetitions=0).mean == (3 + 4 + 5 + 6) / 4 == trim_mean(values, 0.25)
    # Over tasks the runs are pooled, whatever their numbers.
    assert iqm([values[:5], values[5:]], repetitions=0).mean == 4.5


def test_iqm_interval_is_repeatable_leaves_numpy_alone_and_covers():
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
    assert 19 <= hits <= 25  # 95 % of 25 is 24; twenty runs cost a little
    assert iqm(groups, repetitions=FEW) == iqm(groups, repetitions=FEW)
    assert np.random.random() == expected


def test_iqm_resamples_within_tasks_only():
    """Two tasks far apart, no spread within: resampling across them would make one up."""
    assert iqm([[0.0, 0.0], [100.0, 100.0]], repetitions=FEW) == (50.0, 50.0, 50.0)


def test_one_seed_gets_no_interval():
    for groups in ([[4.0]], [[1.0, 7.0], [4.0]]):
        mean, low, high = iqm(groups, repetitions=FEW)
        assert mean == 4.0 and math.isnan(low) and math.isnan(high)
    assert math.isnan(probability_of_improvement([([1.0, 2.0], [0.0])], repetitions=FEW).low)


def test_probability_of_improvement():
    low, high = [1.0, 2.0, 3.0], [4.0, 5.0]
    assert probability_of_improvement([(high, low)], repetitions=FEW) == (1.0, 1.0, 1.0)
    assert probability_of_improvement([(low, low)], repetitions=0).mean == 0.5
    # By hand: 2 beats one of {1, 3} and 3 beats one and ties with one, of 4 pairs; and 0 of 2.
    tied = ([2.0, 3.0], [1.0, 3.0])
    assert probability_of_improvement([tied], repetitions=0).mean == (1 + 1.5) / 4
    both = probability_of_improvement([tied, (low[:1], high)], repetitions=0).mean
    assert both == (2.5 / 4 + 0) / 2


def test_probability_of_improvement_is_rliables():
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 5, (6, 3)).astype(float), rng.integers(0, 5, (4, 3)).astype(float)
    ours = probability_of_improvement(list(zip(x.T, y.T, strict=True)), repetitions=0).mean
    assert ours == pytest.approx(metrics.probability_of_improvement(x, y))


def test_band_is_an_interval_of_the_mean_from_three_seeds_up():
    values = np.array([[0.0, 5.0], [1.0, 5.0], [5.0, 5.0]])
    low, high = mean_band(values, repetitions=200)
    assert 0.0 <= low[0] < 2.0 < high[0] < 5.0 + 1e-9
    assert low[1] == high[1] == 5.0
    low, high = mean_band(values[[0, 2]])
    assert (low[0], high[0]) == (0.0, 5.0)


# Comparing


def test_budget_is_the_most_that_all_runs_share(tmp_path):
    sac = run([0, 1, 2], [0, 50_000, 100_000])
    etl = run([0, 3, 5, 6], [0, 49_900, 99_000, 150_000], method="etl")
    runs = sweep(tmp_path, sac, etl).runs
    assert common_budget(runs) == 100_000
    comparison = compare(runs, ["sac", "etl"], "sac", repetitions=FEW)
    assert comparison.result("etl").returns.tolist() == [5.0]
    assert comparison.result("etl").improvement == 1.0
    assert comparison.result("sac").improvement is None and not comparison.stale
    # A grid that never meets the other's: the last evaluation counts, and is named.
    runs = sweep(tmp_path, sac, run([0, 4, 8], [0, 30_000, 80_000], method="etl")).runs
    comparison = compare(runs, ["sac", "etl"], "sac", repetitions=FEW)
    assert comparison.budget == 80_000 and comparison.result("sac").returns.tolist() == [1.0]
    assert [one.method for one in comparison.stale] == ["sac"]


def test_a_batch_more_or_less_at_the_end_changes_nothing(tmp_path):
    sac = run([0, 1, 2], [0, 45_056, 50_048])
    sar = run([0, 3, 4], [0, 45_064, 50_056], method="sar")
    late = run([0, 5, 6], [0, 49_000, 50_600], method="etl")
    runs = sweep(tmp_path, sac, sar, late).runs
    for frames in (50_000, None):
        comparison = compare(runs, ["sac", "sar", "etl"], "sac", frames=frames, repetitions=FEW)
        assert comparison.budget == (frames or 50_048)
        assert comparison.result("sac").returns.tolist() == [2.0]
        assert comparison.result("sar").returns.tolist() == [4.0]
        assert not comparison.short and not comparison.stale
    assert compare(runs, ["etl"], "sac", frames=50_000).result("etl").returns.tolist() == [5.0]


def test_runs_that_end_before_an_asked_budget_are_left_out(tmp_path):
    runs = sweep(tmp_path, run([0, 1, 2, 3]), run([0, 5], method="etl")).runs
    comparison = compare(runs, ["sac", "etl"], "sac", frames=150_000, repetitions=FEW)
    assert comparison.result("etl") is None
    assert [one.method for one in comparison.short] == ["etl"]


def test_frames_to_the_controls_return_are_those_of_the_mean_over_seeds(tmp_path):
    frames = [0, 10, 20, 30]
    results = sweep(
        tmp_path,
        run([0, 1, 5, 4], frames, seed=0),
        run([0, 1, 3, 2], frames, seed=1),  # sac ends at a mean of 3
        run([0, 9, 0, 3], frames, method="etl", seed=0),
        run([0, -5, 6, 0], frames, method="etl", seed=1),  # means of 2, 3 and 1.5
        run([2, 2, 2, 2], frames, method="sar"),
    )
    compared = compare(results.finished, ["sac", "etl", "sar"], "sac", repetitions=FEW)
    reached = {result.method: result.frames_to_control for result in compared.results}
    assert reached == {"sac": 20, "etl": 20, "sar": None}
    alone = compare(results.finished, ["etl"], "sac", repetitions=FEW)
    assert alone.result("etl").frames_to_control is None


def test_unequal_seeds_and_missing_tasks(tmp_path):
    """By hand. Key Turn at 100,000: zero −100, one 2211.99 (FlashSAC). Leg Walk: one is SAC's."""
    turn = [run([-100, 0, 2211.99], method="sac", seed=s) for s in (0, 1, 2)]
    better = [run([-100, 0, 2211.99 + 2311.99], method="etl", seed=s) for s in (0, 1)]
    walk = [run([-50, 0, 50], task="myoLegWalk", seed=s) for s in (0, 1)]
    results = sweep(tmp_path, *turn, *better, *walk)
    comparisons = [
        compare(
            [one for one in results.runs if one.setting == setting],
            ["sac", "etl"],
            "sac",
            repetitions=FEW,
        )
        for setting in results.settings
    ]
    scales = [normalize(comparison, "sac") for comparison in comparisons]
    assert scales[0] == Scale(-100.0, 2211.99, "FlashSAC, published")
    assert scales[1] == Scale(-50.0, 50.0, "sac, mean here")
    sac, etl = overall(comparisons, scales, ["sac", "etl"], "sac", repetitions=FEW)
    assert sac.iqm == pytest.approx((1.0, 1.0, 1.0)) and not sac.missing
    assert etl.iqm == pytest.approx((2.0, 2.0, 2.0))
    assert etl.missing == (("myoLegWalk", "fixed"),)
    assert etl.control_iqm == pytest.approx(1.0) and etl.improvement == (1.0, 1.0, 1.0)


def test_a_task_without_a_sound_scale_says_why(tmp_path):
    other = run([0, 1, 2], task="myoLegWalk", method="etl")
    worse = run([0, -1, -2], task="myoRelocate")
    for rows, words in ((other, "sac lacks the task"), (worse, "is not above the untrained")):
        comparison = compare(sweep(tmp_path, rows).runs, ["sac", "etl"], "sac", repetitions=FEW)
        assert words in normalize(comparison, "sac")
