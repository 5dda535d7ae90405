"""Methods compared at an equal number of frames, and scores normalized over tasks."""

from __future__ import annotations

import pytest

from tests.sweep_rows import FEW, run, sweep
from torchrl_etl.analysis.sweep_statistics import Scale, common_budget, compare, normalize, overall


def test_budget_is_the_largest_that_all_runs_reached(tmp_path):
    sac = run([0, 1, 2], [0, 50_000, 100_000])
    etl = run([0, 3, 5, 6], [0, 49_900, 99_000, 150_000], method="etl")
    runs = sweep(tmp_path, sac, etl).runs
    assert common_budget(runs) == 100_000
    comparison = compare(runs, ["sac", "etl"], "sac", repetitions=FEW)
    assert comparison.result("etl").returns.tolist() == [5.0]
    assert comparison.result("etl").improvement == 1.0
    assert comparison.result("sac").improvement is None and not comparison.evaluated_early
    # At other frames than etl's: sac's last evaluation before the budget counts, marked as stale.
    runs = sweep(tmp_path, sac, run([0, 4, 8], [0, 30_000, 80_000], method="etl")).runs
    comparison = compare(runs, ["sac", "etl"], "sac", repetitions=FEW)
    assert comparison.budget == 80_000 and comparison.result("sac").returns.tolist() == [1.0]
    assert [one.method for one in comparison.evaluated_early] == ["sac"]


def test_budget_tolerates_a_batch_more_or_less(tmp_path):
    sac = run([0, 1, 2], [0, 45_056, 50_048])
    sar = run([0, 3, 4], [0, 45_064, 50_056], method="sar")
    late = run([0, 5, 6], [0, 49_000, 50_600], method="etl")
    runs = sweep(tmp_path, sac, sar, late).runs
    for frames in (50_000, None):
        comparison = compare(runs, ["sac", "sar", "etl"], "sac", frames=frames, repetitions=FEW)
        assert comparison.budget == (frames or 50_048)
        assert comparison.result("sac").returns.tolist() == [2.0]
        assert comparison.result("sar").returns.tolist() == [4.0]
        assert not comparison.ended_early and not comparison.evaluated_early
    assert compare(runs, ["etl"], "sac", frames=50_000).result("etl").returns.tolist() == [5.0]


def test_runs_shorter_than_a_given_budget_are_left_out(tmp_path):
    runs = sweep(tmp_path, run([0, 1, 2, 3]), run([0, 5], method="etl")).runs
    comparison = compare(runs, ["sac", "etl"], "sac", frames=150_000, repetitions=FEW)
    assert comparison.result("etl") is None
    assert [one.method for one in comparison.ended_early] == ["etl"]


def test_runs_first_evaluated_after_a_given_budget_are_left_out(tmp_path):
    explored = run([5, 6], [8_000, 10_000], method="etl")
    runs = sweep(tmp_path, run([0, 1, 2], [0, 5_000, 10_000]), explored).runs
    comparison = compare(runs, ["sac", "etl"], "sac", frames=5_000, repetitions=FEW)
    assert comparison.result("etl") is None and not comparison.ended_early
    assert [one.method for one in comparison.evaluated_late] == ["etl"]


def test_frames_to_the_controls_return_use_the_mean_over_seeds(tmp_path):
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


def test_overall_iqm_with_unequal_seeds_and_a_missing_task(tmp_path):
    """Key Turn is scaled from -100 to FlashSAC's 2211.99, Leg Walk from -50 to SAC's 50."""
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


def test_task_that_cannot_be_normalized_says_why(tmp_path):
    other = run([0, 1, 2], task="myoLegWalk", method="etl")
    worse = run([0, -1, -2], task="myoRelocate")
    for rows, words in (
        (other, "sac has no run on this task"),
        (worse, "is not above the untrained"),
    ):
        comparison = compare(sweep(tmp_path, rows).runs, ["sac", "etl"], "sac", repetitions=FEW)
        assert words in normalize(comparison, "sac")
