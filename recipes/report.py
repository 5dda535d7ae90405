"""Report of a sweep: tables at equal frames and learning curves, from its results.csv.

    python recipes/report.py results=FOLDER [out=FOLDER] [frames=N] [control=sac] [repetitions=2000]

results      folder with results.csv, one row per evaluation
out          folder for report.md and the plots; default: that of the results
frames       environment frames at which to compare; default: the most that a task's runs share
control      the method against which improvement is measured
repetitions  number of resamples for each bootstrap interval
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from pathlib import Path

from torchrl_etl.analysis.sweep_report import write_report
from torchrl_etl.analysis.sweep_results import read_sweep
from torchrl_etl.command_line import exit_on_error

DEFAULTS = {"results": "", "out": "", "frames": "", "control": "sac", "repetitions": "2000"}


def main(arguments: Sequence[str]) -> None:
    settings = _settings(arguments)
    with exit_on_error(ValueError, OSError, ImportError):
        frames = _count("frames", settings["frames"]) if settings["frames"] else None
        repetitions = _count("repetitions", settings["repetitions"])
        if not settings["results"]:
            raise ValueError("no results are given; pass results=FOLDER, which has results.csv.")
        results = Path(settings["results"]).expanduser()
        sweep, folder = read_sweep(results), Path(settings["out"] or results).expanduser()
        tasks, methods = write_report(
            sweep,
            folder,
            arguments,
            control=settings["control"],
            frames=frames,
            repetitions=repetitions,
        )
    print(f"tasks: {tasks}, methods: {methods}, finished runs: {len(sweep.finished)}")
    print(f"  written to {folder / 'report.md'}")


def _settings(arguments: Sequence[str]) -> dict[str, str]:
    if {"-h", "--help"} & set(arguments):
        print(__doc__.strip())
        sys.exit()
    settings = dict(DEFAULTS)
    for argument in arguments:
        key, separator, value = argument.partition("=")
        if not separator:
            sys.exit(f"Error: {argument!r} is not of the form key=value; see --help.")
        if key not in settings:
            near = difflib.get_close_matches(key, settings, n=3)
            hint = f"did you mean {' or '.join(near)}?" if near else "--help lists them all."
            sys.exit(f"Error: there is no setting {key!r}; {hint}")
        settings[key] = value
    return settings


def _count(name: str, text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise ValueError(f"{name} is {text!r}; it must be a whole number, 1 or more.")
    return int(text)


if __name__ == "__main__":
    main(sys.argv[1:])
