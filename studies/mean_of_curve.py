"""Mean return of each run between two frame counts, from its evaluations in results.csv.

    python studies/mean_of_curve.py docs/results/first 100000 300000

The curve is linear between evaluations. A mean over the evaluations themselves would compare later
stretches of one method with earlier ones of another, as methods that explore first are evaluated at
other frames. Unfinished runs are left out, and runs that end more than 1 % early.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import fmean

import numpy as np

from torchrl_etl.analysis.sweep_results import read_sweep
from torchrl_etl.command_line import exit_on_error


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="has results.csv")
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    arguments = parser.parse_args()
    first, last = arguments.first, arguments.last
    if first >= last:
        parser.error(f"first is {first}; it must be below last, which is {last}.")
    with exit_on_error(OSError, ValueError):
        sweep = read_sweep(arguments.folder)
    means: dict[tuple[str, ...], dict[int, float]] = {}
    for run in sweep.finished:
        frames, returns = run.curve("mean_return")
        if frames[0] <= first and frames[-1] >= 0.99 * last:
            of_method = means.setdefault((*run.setting, run.method), {})
            of_method[run.seed] = mean_of_curve(frames, returns, first, last)
    for (task, goal, method), found in means.items():
        seeds = ", ".join(f"{seed}: {mean:,.0f}" for seed, mean in sorted(found.items()))
        print(f"{task} ({goal}), {method}: {fmean(found.values()):,.0f} ({seeds})")


def mean_of_curve(frames: np.ndarray, returns: np.ndarray, first: float, last: float) -> float:
    """Mean over [first, last] of a curve that is linear between its points, level after the last.

    Examples:
        >>> mean_of_curve(np.array([0.0, 10.0]), np.array([0.0, 1.0]), 5, 15)
        0.875
    """
    inside = frames[(frames > first) & (frames < last)]
    at = np.array([first, *inside, last])
    return float(np.trapezoid(np.interp(at, frames, returns), at) / (last - first))


if __name__ == "__main__":
    main()
