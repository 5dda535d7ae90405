"""The report of a sweep: its tables and pictures."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_etl.analysis.published import caveats, environment_id, published_curves
from torchrl_etl.analysis.statistics import Interval
from torchrl_etl.analysis.sweep_pictures import looks, overall_picture, task_picture
from torchrl_etl.analysis.sweep_results import SweepResults
from torchrl_etl.analysis.sweep_statistics import (
    Comparison,
    MethodResult,
    OverallResult,
    Scale,
    compare,
    normalize,
    overall,
)
from torchrl_etl.checks import check_choice
from torchrl_etl.io import write_atomically

__all__ = ["write_report"]

HOW_TO_READ = """\
How to read the tables. A run is represented by its last evaluation up to 1 % past the budget, \
since runs end with a whole batch; nothing is interpolated. `mean` and the range are over seeds. \
`IQM` is the interquartile mean (for three seeds or fewer: the mean) with the 95 % interval of the \
percentile bootstrap, seeds resampled within each task (rliable); for two seeds it is their range. \
`P(> {control})` is the probability that a run beats a run of {control}, ties counted as half. \
`frames to {control}'s` is when the mean over seeds first reaches the final mean of {control}. \
One seed shows no spread, so it gets no interval. `solved` is the share of episodes, \
`solved time` the share of steps."""


def write_report(
    sweep: SweepResults,
    folder: Path,
    arguments: Sequence[str],
    *,
    control: str = "sac",
    frames: int | None = None,
    repetitions: int = 2000,
) -> tuple[int, int]:
    """Write report.md and its plots into a folder; returns the numbers of tasks and methods.

    ``arguments`` are the command-line settings, quoted in the report. Other arguments as for
    :func:`~torchrl_etl.analysis.sweep_statistics.compare`.

    Raises:
        ValueError: for a control that was not run, or frames that no run reached.
    """
    methods = _methods(sweep, control)
    comparisons = [
        compare(runs, methods, control, frames=frames, repetitions=repetitions)
        for runs in sweep.finished_by_task
    ]
    if not any(comparison.results for comparison in comparisons):  # before a report is replaced
        most = max(run.last_frames for run in sweep.finished)
        raise ValueError(
            f"frames is {frames}, where no finished run has an evaluation; the longest run has "
            f"{most:,} frames."
        )
    folder.mkdir(parents=True, exist_ok=True)
    styles = looks(methods)
    for runs, comparison in zip(sweep.finished_by_task, comparisons, strict=True):
        picture = folder / _picture(comparison.setting)
        task_picture(runs, styles, picture, budget=comparison.budget, repetitions=repetitions)
    scales = [normalize(comparison, control) for comparison in comparisons]
    results = overall(comparisons, scales, methods, control, repetitions=repetitions)
    if results:
        overall_picture(results, styles, folder / "overall.png")
    parts = [
        "# Sweep report",
        *_header(sweep, arguments, control),
        "## Over all tasks",
        *_overall(results, comparisons, scales, control),
    ]
    for setting in sweep.settings:
        found = next((c for c in comparisons if c.setting == setting), None)
        parts += ["## {} ({} goal)".format(*setting)]
        parts += _task(found, methods, control) if found else ["No run finished."]
    parts += ["## Runs that did not finish", *_unfinished(sweep)]
    parts += ["## What produced the numbers", *_origins(sweep)]
    write_atomically(folder / "report.md", "\n\n".join(parts) + "\n")
    return len(comparisons), len(methods)


def _methods(sweep: SweepResults, control: str) -> list[str]:
    """Methods with a finished run, the control first."""
    if not sweep.finished:
        raise ValueError(f"None of the {len(sweep.runs)} runs finished: nothing to report.")
    methods = sorted({run.method for run in sweep.finished})
    check_choice("control", control, methods)
    return [control, *(method for method in methods if method != control)]


def _header(sweep: SweepResults, arguments: Sequence[str], control: str) -> list[str]:
    command = shlex.join(["python", "recipes/report.py", *arguments])
    counts = (
        f"{sweep.row_count} evaluations of {len(sweep.runs)} runs; {len(sweep.finished)} runs "
        f"finished and {len(sweep.unfinished)} did not. Tables and pictures show only "
        "finished runs."
    )
    if sweep.replaced:
        counts += (
            f" {sweep.replaced} evaluations are left out, since their runs were repeated later."
        )
    never = sorted({run.method for run in sweep.unfinished} - {r.method for r in sweep.finished})
    if never:
        counts += f" No run of {', '.join(never)} finished."
    return [f"`{command}`", counts, HOW_TO_READ.format(control=control)]


def _overall(
    results: Sequence[OverallResult],
    comparisons: Sequence[Comparison],
    scales: Sequence[Scale | str],
    control: str,
) -> list[str]:
    parts = [
        "Returns are normalized per task, (x − zero)/(one − zero): zero is the mean return of the "
        f"untrained policies, one is the best published mean at the same frames, or {control}'s "
        "mean if nothing is published. Runs of all tasks are pooled, so a task with more seeds "
        "weighs more. A method is averaged over the tasks that it has results for; column "
        f"`{control} there` has {control} on the same tasks.",
    ]
    if results:
        rows = [
            (
                result.method,
                str(len(result.settings)),
                *_interval(result.iqm),
                "-" if result.control_iqm is None else f"{result.control_iqm:.3f}",
                *(("-", "-") if result.improvement is None else _interval(result.improvement)),
            )
            for result in results
        ]
        header = ("method", "tasks", "IQM", "95 %", f"{control} there", f"P(> {control})", "95 %")
        parts += [_table(header, rows), "![Methods over all tasks](overall.png)"]
        for result in results:
            if result.missing:
                parts.append(f"{result.method} lacks {_names(result.missing)}.")
    else:
        parts.append("No task has a scale; the reasons are below.")
    rows = []
    for comparison, scale in zip(comparisons, scales, strict=True):
        name, budget = "{} ({})".format(*comparison.setting), f"{comparison.budget:,}"
        if isinstance(scale, Scale):
            zero, one = _plain(scale.zero), _plain(scale.one)
            rows.append((name, budget, zero, one, scale.source))
        else:
            rows.append((name, budget, "-", "-", f"left out: {scale}"))
    parts.append(_table(("task", "frames", "zero", "one", "source of one"), rows))
    late = [c for c in comparisons if c.untrained_frames > 0]
    if late:
        parts.append(
            "No evaluation at frame 0, so zero is the mean of the first evaluations "
            "and normalized returns are too low: "
            + ", ".join("{} ({})".format(*c.setting) + f" at {c.untrained_frames:,}" for c in late)
            + "."
        )
    return parts


def _task(comparison: Comparison, methods: Sequence[str], control: str) -> list[str]:
    parts = [f"At {comparison.budget:,} environment frames, exploration included."]
    solved = any(np.isfinite(result.solved).any() for result in comparison.results)
    header = ["method", "seeds", "mean", "min to max", "IQM", "95 %", f"P(> {control})"]
    header += [f"frames to {control}'s", *["solved", "solved time"] * solved, "wall time [h]"]
    if comparison.results:
        parts.append(_table(header, [_method_row(result, solved) for result in comparison.results]))
    notes = []
    absent = [name for name in methods if comparison.result(name) is None]
    if absent:
        notes.append(f"No finished run to compare at the budget: {', '.join(absent)}.")
    if len({len(result.seeds) for result in comparison.results}) > 1:
        notes.append("The methods have unequal numbers of seeds.")
    if comparison.ended_early:
        notes.append(f"Left out, ended before the budget: {_runs(comparison.ended_early)}.")
    if comparison.evaluated_late:
        notes.append(
            f"Left out, first evaluated after the budget: {_runs(comparison.evaluated_late)}."
        )
    if comparison.evaluated_early:
        notes.append(
            "Represented by an evaluation more than 5 % before the budget: "
            f"{_runs(comparison.evaluated_early)}."
        )
    env_id = environment_id(*comparison.setting)
    if published_curves(env_id) or published_curves(env_id, "success"):
        notes.append(caveats(env_id))
    if notes:
        parts.append("\n".join(f"- {note}" for note in notes))
    return [*parts, f"![Learning curves]({_picture(comparison.setting)})"]


def _method_row(result: MethodResult, solved: bool) -> tuple[str, ...]:
    returns = result.returns
    one = len(returns) == 1
    return (
        result.method,
        str(len(result.seeds)),
        _plain(returns.mean()),
        "-" if one else f"{_plain(returns.min())} to {_plain(returns.max())}",
        *_interval(result.iqm, _plain),
        "-" if result.improvement is None else f"{result.improvement:.2f}",
        "-" if result.frames_to_control is None else f"{result.frames_to_control:,}",
        *((_percent(result.solved), _percent(result.solved_time)) if solved else ()),
        _mean(result.wall_seconds / 3600, "{:.2f}"),
    )


def _unfinished(sweep: SweepResults) -> list[str]:
    if not sweep.unfinished:
        return ["None."]
    lines = []
    for run in sweep.unfinished:
        last = f"last evaluated at {run.last_frames:,} frames" if run.evaluated else "no evaluation"
        lines.append(f"- {run}: {run.status}, {last}")
    return ["\n".join(lines)]


def _origins(sweep: SweepResults) -> list[str]:
    """Where the finished runs come from, with the number of runs of each origin."""
    commits, machines, settings, versions = Counter(), Counter(), Counter(), Counter()
    mixed = []
    for run in sweep.finished:
        own = {row.commit or "unknown" for row in run.rows}
        commits.update(own)
        if len(own) > 1:
            mixed.append(run)
        machines.update({row.machine or "unknown" for row in run.rows})
        settings.update({row.settings for row in run.rows if row.settings})
        versions.update({pair for row in run.rows for pair in row.versions.items()})
    parts = [
        _table(("commit", "runs"), [(name, str(n)) for name, n in sorted(commits.items())]),
        _table(("machine", "runs"), [(name, str(n)) for name, n in sorted(machines.items())]),
    ]
    if len(machines) > 1:
        parts.append("Wall times of different machines cannot be compared.")
    if mixed:
        parts.append(f"Runs with more than one commit: {_runs(mixed)}.")
    if settings:
        rows = [(f"`{name}`", str(n)) for name, n in sorted(settings.items())]
        parts.append(_table(("settings", "runs"), rows))
    if versions:
        rows = [(*pair, str(count)) for pair, count in sorted(versions.items())]
        parts.append(_table(("package", "version", "runs"), rows))
    return parts


def _interval(interval: Interval, number=lambda value: f"{value:.3f}") -> tuple[str, str]:
    point, low, high = interval
    if math.isnan(low):
        return number(point), "one seed: no interval"
    return number(point), f"{number(low)} to {number(high)}"


def _plain(value: float) -> str:
    """A return with a suitable number of digits: 2,212 or 68.3 or 0.123."""
    digits = 0 if abs(value) >= 1000 else 1 if abs(value) >= 10 else 3
    return f"{value:,.{digits}f}"


def _percent(shares: np.ndarray) -> str:
    return _mean(100 * shares, "{:.0f} %")


def _mean(values: np.ndarray, form: str) -> str:
    known = values[np.isfinite(values)]
    return form.format(known.mean()) if known.size else "-"


def _names(settings: Sequence[tuple[str, str]]) -> str:
    return ", ".join("{} ({})".format(*setting) for setting in settings)


def _runs(runs: Sequence[object]) -> str:
    return "; ".join(map(str, runs))


def _picture(setting: tuple[str, str]) -> str:
    return re.sub(r"[^\w.-]+", "_", "-".join(setting)) + ".png"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    # A bar within a cell, as in a status or a machine's name, would end the cell.
    cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    lines = [header, ["---"] * len(header), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
