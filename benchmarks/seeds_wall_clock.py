"""Wall-clock seconds of two seeds: in one process, beside a process for each.

    python benchmarks/seeds_wall_clock.py
    python benchmarks/seeds_wall_clock.py --env myoLegWalk --frames 20000

Whole commands of the recipe, from start to summary, on all cores; they take turns. ``processes``
have a thread of PyTorch each, one process has as many as there are cores. ``ahead`` has the seeds'
simulators in processes of their own, one batch ahead of the learners; the others step them in the
process that learns. A ratio is to ``processes``, and on two cores 1 where a seed in company is
no slower than alone.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from harness import interleave, line

RECIPE = Path(__file__).resolve().parents[1] / "recipes" / "etl_sac.py"
SEEDS = (0, 1)
AHEAD = ["collector=process", "collector.num_envs=1"]


def seconds(commands: list[list[str]]) -> float:
    """Until the last of these has ended, which all begin at once."""
    with TemporaryDirectory() as folder:
        begun = time.perf_counter()
        processes = [
            subprocess.Popen([*command, f"run_dir={folder}/{i}"], stdout=subprocess.DEVNULL)
            for i, command in enumerate(commands)
        ]
        ended = [process.wait() for process in processes]
        taken = time.perf_counter() - begun
    if any(ended):
        raise SystemExit(f"Error: a run ended with {ended}.")
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandKeyTurn")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--overrides", nargs="*", default=[], help="further settings of all runs")
    arguments = parser.parse_args()

    run = [sys.executable, str(RECIPE), f"env={arguments.env}", f"frames={arguments.frames}"]
    run += ["method=sac", "compile=true", "progress=false", "pictures=false"]
    run += ["evaluation.every=0", "evaluation.episodes=1", *arguments.overrides]
    together = [*run, f"seeds=[{','.join(map(str, SEEDS))}]"]
    alone = [[*run, "threads=1", f"seed={seed}"] for seed in SEEDS]
    cases = {
        "processes": partial(seconds, alone),
        "one_process": partial(seconds, [together]),
        "one_process_ahead": partial(seconds, [[*together, *AHEAD]]),
    }
    values = interleave(cases, arguments.repeats)
    more = {"env": arguments.env, "frames": arguments.frames, "seeds": len(SEEDS)}
    for name, each in values.items():
        line("seeds_wall_clock", name, "s", each, peers={"processes": values["processes"]}, **more)


if __name__ == "__main__":
    main()
