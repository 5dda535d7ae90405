"""A file of runs for the goals: SAC and ETL on six tasks of MyoSuite's hand.

    python -m studies.many_runs.goals goals --seeds 0 1 2 --jobs 2
    python -m studies.many_runs goals/runs.json --out goals/results.csv --device cuda --workers 9

The first explores, with the recipe, what ETL's runs start from, and takes some minutes of one core
for each; bundles that are there already are not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from torchrl_etl.synergies import load_bundle

ROOT = Path(__file__).parents[2]
TASKS = ("myo2HandPose", "myoHandKeyTurn", "myoHandPenTwirl")
EXPLORED = 4000  # frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--goals", nargs="+", default=["fixed", "random"])
    parser.add_argument("--frames", type=int, default=100_000, help="with those of exploration")
    parser.add_argument("--jobs", type=int, default=2, help="explorations at a time")
    arguments = parser.parse_args()
    runs = [
        {"task": task, "goal": goal, "seed": seed}
        for seed in arguments.seeds
        for goal in arguments.goals
        for task in TASKS
    ]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        bundles = list(pool.map(lambda run: explored(run, arguments.folder), runs))
    etl = [
        run | {"method": "etl", "synergies": os.path.relpath(bundle), "charged": charged(bundle)}
        for run, bundle in zip(runs, bundles, strict=True)
    ]
    groups = [{"runs": [run | {"method": "sac"} for run in runs]}, {"reuse": True, "runs": etl}]
    described = {"frames": arguments.frames, "groups": groups}
    (arguments.folder / "runs.json").write_text(json.dumps(described, indent=1), encoding="utf-8")
    print(f"{2 * len(runs)} runs: {arguments.folder / 'runs.json'}")


def explored(run: dict[str, str | int], folder: Path) -> Path:
    """The bundle of a run of stage 1 alone."""
    path = (folder / "{task}-{goal}-seed{seed}".format(**run)).resolve()
    if not (path / "synergies").is_dir():
        subprocess.run([*command(run), f"run_dir={path}"], check=True, cwd=ROOT)
    return path / "synergies"


def charged(bundle: Path) -> int:
    """Frames of an exploration, which ends with a whole batch."""
    return load_bundle(bundle)[1].facts["frames"]


def command(run: dict[str, str | int]) -> Iterator[str]:
    yield from (sys.executable, "recipes/etl_sac.py", "stage=explore", "threads=1")
    yield from (
        "env={task}".format(**run),
        "goal={goal}".format(**run),
        "seed={seed}".format(**run),
    )
    yield from (f"explore.frames={EXPLORED}", "evaluation.every=0", "pictures=false")
    yield "progress=false"


if __name__ == "__main__":
    main()
