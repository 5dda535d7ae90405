"""Comparison of a sweep's methods at equal frames, per task and over all tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchrl_etl.analysis.bootstrap import iqm, probability_of_improvement
from torchrl_etl.analysis.published import best_published, environment_id
from torchrl_etl.analysis.statistics import Interval
from torchrl_etl.analysis.sweep_results import SweepRun

__all__ = [
    "Comparison",
    "MethodResult",
    "OverallResult",
    "Scale",
    "common_budget",
    "compare",
    "normalize",
    "overall",
]

# Relative tolerance for evaluations before the budget. Episodes of varying length put evaluations
# at slightly different frames.
_TOLERANCE = 0.05


@dataclass(frozen=True)
class MethodResult:
    """One method on one task at the budget; arrays have one number per run, in order of seeds.

    ``frames_to_control`` are the frames at which its mean return first reaches the control's at
    the budget; ``None`` if it never does, or if there is no control.
    """

    method: str
    seeds: tuple[int, ...]
    frames: np.ndarray
    returns: np.ndarray
    solved: np.ndarray
    solved_time: np.ndarray
    wall_seconds: np.ndarray
    iqm: Interval
    improvement: float | None
    frames_to_control: int | None


@dataclass(frozen=True)
class Comparison:
    """The methods on one task at one budget.

    Attributes:
        setting: Task and goal.
        budget: Environment frames at which methods are compared.
        results: One per method, in the order of the methods.
        untrained: Mean return of the evaluations at ``untrained_frames``, over all runs.
        untrained_frames: The smallest number of frames at which a run was evaluated; usually 0.
        ended_early: Runs left out because they ended before the budget.
        evaluated_late: Runs left out because they were first evaluated after the budget, such as
            those of a method that explores for longer.
        evaluated_early: Runs whose last evaluation within the budget is more than 5 % before it.
    """

    setting: tuple[str, str]
    budget: int
    results: tuple[MethodResult, ...]
    untrained: float
    untrained_frames: int
    ended_early: tuple[SweepRun, ...]
    evaluated_late: tuple[SweepRun, ...]
    evaluated_early: tuple[SweepRun, ...]

    def result(self, method: str) -> MethodResult | None:
        return next((result for result in self.results if result.method == method), None)


def common_budget(runs: Sequence[SweepRun]) -> int:
    """The largest number of frames at which all runs can be compared.

    No run ends before it. If possible, every run has an evaluation at most 5 % before it.

    Raises:
        ValueError: if there are no runs.
    """
    if not runs:
        raise ValueError("There are no finished runs to compare; finish at least one.")
    end = min(run.last_frames for run in runs)
    evaluated = {row.frames for run in runs for row in run.rows if 0 < row.frames <= end}
    shared = (
        b for b in sorted(evaluated, reverse=True) if not any(_evaluated_early(r, b) for r in runs)
    )
    return next(shared, end)


def compare(
    runs: Sequence[SweepRun],
    methods: Sequence[str],
    control: str,
    *,
    frames: int | None = None,
    repetitions: int = 2000,
) -> Comparison:
    """Compare the methods on one task at the same number of frames.

    Each run is represented by its last evaluation up to 1 % past that number, without
    interpolation. ``frames`` defaults to :func:`common_budget`. Improvement is over ``control``;
    ``repetitions`` is the number of bootstrap resamples.

    Raises:
        ValueError: if there are no runs, or they are from several tasks.
    """
    if len({run.setting for run in runs}) != 1:
        raise ValueError("The runs must be of one task and goal; pass at least one, and no others.")
    budget = common_budget(runs) if frames is None else frames
    ended_early = [run for run in runs if run.last_frames < (1 - _TOLERANCE) * budget]
    evaluated_late = [run for run in runs if run.evaluation_at(budget) is None]
    fair = [run for run in runs if run not in (*ended_early, *evaluated_late)]
    by_method = {name: [run for run in fair if run.method == name] for name in methods}
    baseline = [run.evaluation_at(budget).mean_return for run in by_method.get(control, ())]
    first = min(run.rows[0].frames for run in runs)
    untrained = [run.rows[0].mean_return for run in runs if run.rows[0].frames == first]
    return Comparison(
        setting=runs[0].setting,
        budget=budget,
        results=tuple(
            _result(name, group, budget, baseline, name == control, repetitions)
            for name, group in by_method.items()
            if group
        ),
        untrained=float(np.mean(untrained)),
        untrained_frames=first,
        ended_early=tuple(ended_early),
        evaluated_late=tuple(evaluated_late),
        evaluated_early=tuple(run for run in fair if _evaluated_early(run, budget)),
    )


class Scale(NamedTuple):
    """Returns normalized to zero and one on a task, and the source of the latter."""

    zero: float
    one: float
    source: str


def normalize(comparison: Comparison, control: str) -> Scale | str:
    """The scale for averaging a task's returns with other tasks', or the reason for having none.

    Zero is the return of the untrained policies, so negative returns are possible. One is the best
    published return at the same frames, or the control's mean if nothing was published.

    Equation:
        (x − zero)/(one − zero)
    """
    zero = comparison.untrained
    published = best_published(environment_id(*comparison.setting), comparison.budget)
    if published is not None:
        one, source = published[0], f"{published[1]}, published"
    elif (baseline := comparison.result(control)) is not None:
        one, source = float(baseline.returns.mean()), f"{control}, mean here"
    else:
        return (
            f"nothing is published at {comparison.budget:,} frames and {control} has no run on "
            "this task"
        )
    if one <= zero:
        return f"the reference ({source}: {one:.4g}) is not above the untrained {zero:.4g}"
    return Scale(zero, one, source)


@dataclass(frozen=True)
class OverallResult:
    """One method over all of its tasks; ``control_iqm`` is the control's IQM on the same tasks."""

    method: str
    settings: tuple[tuple[str, str], ...]
    missing: tuple[tuple[str, str], ...]
    iqm: Interval
    control_iqm: float | None
    improvement: Interval | None


def overall(
    comparisons: Sequence[Comparison],
    scales: Sequence[Scale | str],
    methods: Sequence[str],
    control: str,
    *,
    repetitions: int = 2000,
) -> tuple[OverallResult, ...]:
    """Aggregate each method's normalized returns over the tasks that have a scale.

    ``comparisons`` has one entry per task, and ``scales`` the result of :func:`normalize` for each.
    Other arguments as for :func:`compare`.
    """
    scaled = [
        (comparison, scale)
        for comparison, scale in zip(comparisons, scales, strict=True)
        if isinstance(scale, Scale)
    ]
    results = []
    for method in methods:
        own = [pair for pair in scaled if pair[0].result(method)]
        if not own:
            continue
        missing = tuple(c.setting for c, _ in scaled if not c.result(method))
        pairs = [
            (c.result(method).returns, c.result(control).returns)
            for c, _ in own
            if c.result(control)
        ]
        shared = len(pairs) == len(own)
        results.append(
            OverallResult(
                method,
                tuple(c.setting for c, _ in own),
                missing,
                iqm(_normalized(own, method), repetitions=repetitions),
                iqm(_normalized(own, control), repetitions=0).mean if shared else None,
                probability_of_improvement(pairs, repetitions=repetitions)
                if pairs and method != control
                else None,
            )
        )
    return tuple(results)


def _normalized(scaled: Sequence[tuple[Comparison, Scale]], method: str) -> list[np.ndarray]:
    return [(c.result(method).returns - s.zero) / (s.one - s.zero) for c, s in scaled]


def _result(
    method: str,
    runs: Sequence[SweepRun],
    budget: int,
    baseline: Sequence[float],
    is_control: bool,
    repetitions: int,
) -> MethodResult:
    rows = [run.evaluation_at(budget) for run in runs]
    columns = ("frames", "mean_return", "solved", "solved_time", "wall_seconds")
    frames, returns, *others = (
        np.array([getattr(row, name) for row in rows], float) for name in columns
    )
    improvement = None
    if baseline and not is_control:
        improvement = probability_of_improvement([(returns, baseline)], repetitions=0).mean
    seeds = tuple(run.seed for run in runs)
    interval = iqm([returns], repetitions=repetitions)
    reached = _first_at(runs, float(np.mean(baseline)), budget) if baseline else None
    return MethodResult(method, seeds, frames, returns, *others, interval, improvement, reached)


def _first_at(runs: Sequence[SweepRun], target: float, budget: int) -> int | None:
    """Frames of the first evaluation within the budget where the runs' mean reaches the target."""
    begun = max(run.rows[0].frames for run in runs)
    end = max(run.evaluation_at(budget).frames for run in runs)
    evaluated = {row.frames for run in runs for row in run.rows if begun <= row.frames <= end}
    for frames in sorted(evaluated):
        if np.mean([run.evaluation_at(frames).mean_return for run in runs]) >= target:
            return frames
    return None


def _evaluated_early(run: SweepRun, budget: int) -> bool:
    row = run.evaluation_at(budget)
    return row is None or row.frames < (1 - _TOLERANCE) * budget
