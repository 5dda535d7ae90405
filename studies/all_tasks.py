"""SAC and ETL on every task, from the committed results: the first table of docs/results/README.md.

    python studies/all_tasks.py

A cell has the mean return over seeds at the task's budget, and in brackets the share of the budget
at which this mean first reaches SAC's mean at the end; exploration is charged. ▲ marks a method
whose every run ends above every run of SAC, ▼ one whose every run ends below; one run alone gets
neither.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from torchrl_etl.analysis.published import best_published, environment_id
from torchrl_etl.analysis.sweep_results import read_sweep
from torchrl_etl.analysis.sweep_statistics import Comparison, MethodResult, compare

RESULTS = Path(__file__).parents[1] / "docs" / "results"
BUDGETS = {"goals_temperature": 100_000, "kill_test": 200_000, "body": 300_000, "first": 300_000}
"""Frames at which the runs of each folder are compared."""
CONTROL = "sac"
METHODS = {
    CONTROL: "SAC",
    "etl": "ETL with prefill",
    "etl_no_reuse": "ETL without",
    "etl_body": "Body's synergies",
}


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    print("\n".join(table()))


def table() -> Iterator[str]:
    """Lines of the table, then one sentence per method that counts its tasks."""
    comparisons = [each for folder, frames in BUDGETS.items() for each in compared(folder, frames)]
    header = ["Task, frames", "Seeds", *METHODS.values(), "Published"]
    yield f"| {' | '.join(header)} |"
    yield f"|{'---|' * len(header)}"
    for each in comparisons:
        yield f"| {' | '.join(row(each))} |"
    yield ""
    for method in [*METHODS][1:]:
        yield counted(method, [each for each in comparisons if each.result(method)])


def compared(folder: str, frames: int) -> list[Comparison]:
    """Comparisons of a folder's tasks with runs of SAC."""
    by_task = read_sweep(RESULTS / folder).finished_by_task
    found = [compare(r, [*METHODS], CONTROL, frames=frames, repetitions=0) for r in by_task]
    return [each for each in found if each.result(CONTROL)]


def row(comparison: Comparison) -> tuple[str, ...]:
    task, goal = comparison.setting
    results = [comparison.result(method) for method in METHODS]
    seeds = "/".join("-" if result is None else str(len(result.seeds)) for result in results)
    best = best_published(environment_id(task, goal), comparison.budget)
    return (
        f"{task}{' (random)' * (goal == 'random')}, {comparison.budget // 1000}k",
        seeds,
        *(cell(result, comparison.budget) for result in results),
        "-" if best is None else plain(best[0]),
    )


def cell(result: MethodResult | None, budget: int) -> str:
    if result is None:
        return "-"
    mean = plain(float(result.returns.mean()))
    if result.method == CONTROL:
        return mean
    return f"{mark(result)}{mean} ({'-' if (at := share(result, budget)) is None else f'{at:.2f}'})"


def share(result: MethodResult, budget: int) -> float | None:
    """Share of the budget after which the method has reached SAC's final mean."""
    reached = result.frames_to_control
    return None if reached is None else min(1.0, reached / budget)


def mark(result: MethodResult) -> str:
    return {1.0: "▲ ", 0.0: "▼ "}.get(result.improvement, "") if len(result.seeds) > 1 else ""


def counted(method: str, comparisons: list[Comparison]) -> str:
    """A sentence on the tasks where the method has at least two seeds."""
    found = [(each.result(method), each.budget) for each in comparisons]
    results = [(result, budget) for result, budget in found if len(result.seeds) > 1]
    marks = Counter(mark(result).strip() for result, _ in results)
    shares = [at for result, budget in results if (at := share(result, budget)) is not None]
    return (
        f"- {METHODS[method]}, of {len(results)} with two seeds or more: ahead on {marks['▲']}, "
        f"behind on {marks['▼']}; reaches SAC's final mean on {len(shares)}, in at most half the "
        f"frames on {sum(at <= 0.5 for at in shares)}."
    )


def plain(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 10 else f"{value:.1f}"


if __name__ == "__main__":
    main()
