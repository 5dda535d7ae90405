"""Returns of training episodes per interval of frames: less noisy than fixed-start evaluations.

    python studies/training_returns.py RUN [RUN ...] --out docs/results/kill_test/training.csv
    python studies/training_returns.py RUN [RUN ...] --series loss_actor --out FILE.csv

If a task has a fixed initial state, all evaluation episodes of a deterministic policy are equal.
Training acts with noise, in dozens of episodes between evaluations. ``return`` is the mean in stage
2's log over the ``--stretch`` frames up to ``frames``; ``--series`` selects another series of the
log. Each complete interval with log entries gives one CSV row. Rows are appended.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import fmean

from omegaconf import OmegaConf
from rows import append

from torchrl_etl.command_line import exit_on_error
from torchrl_etl.training.run_folder import RunFolder


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--series", default="return", help="series of the log")
    parser.add_argument("--stretch", type=int, default=25000, help="frames per row")
    parser.add_argument("--out", type=Path, required=True, help="CSV file to append to")
    arguments = parser.parse_args()
    for run in arguments.runs:
        with exit_on_error(OSError):
            config = OmegaConf.load(run / "config.yaml")
        folder = RunFolder(run, config)
        if not (starts := folder.versions):
            parser.error(
                f"{run} does not record its commit and machine; pass a run that has begun."
            )
        start = starts[-1]
        row = {"task": config.env, "method": config.method.name, "seed": config.seed}
        series = folder.series(f"learn/{arguments.series}")
        for frames, mean in stretches(*series, arguments.stretch):
            row |= {"frames": frames, arguments.series: round(mean, 1)}
            with exit_on_error(ValueError):
                append(arguments.out, row | {key: start[key] for key in ("commit", "machine")})


def stretches(frames: list[int], returns: list[float], length: int) -> list[tuple[int, float]]:
    """The end and the mean of each complete interval with log entries."""
    ends = range(length, frames[-1] + 1, length) if frames else ()
    pairs = list(zip(frames, returns, strict=True))
    logged = [(end, [r for f, r in pairs if end - length < f <= end]) for end in ends]
    return [(end, fmean(values)) for end, values in logged if values]


if __name__ == "__main__":
    main()
