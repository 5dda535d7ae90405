"""Wall-clock seconds of two seeds on a CPU: one command, compared with one command each.

    python benchmarks/seeds_wall_clock.py
    python benchmarks/seeds_wall_clock.py --env myoLegWalk --frames 20000

Measures whole commands of the recipe in turn, from start to summary, on all cores. The two separate
commands have one PyTorch thread each. Ratios are to these; 1 means equally fast.
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


def seconds(commands: list[list[str]]) -> float:
    """Time from the simultaneous start of the commands until the last one ends."""
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
        "two_commands": partial(seconds, alone),
        "one_command": partial(seconds, [together]),
    }
    values = interleave(cases, arguments.repeats)
    more = {"env": arguments.env, "frames": arguments.frames, "seeds": len(SEEDS)}
    peers = {"two_commands": values["two_commands"]}
    for name, each in values.items():
        line("seeds_wall_clock", name, "s", each, peers=peers, **more)


if __name__ == "__main__":
    main()
