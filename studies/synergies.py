"""Quality of stage 1's synergies, with default settings and the paper's; one CSV row per run.

    python studies/synergies.py --env myoHandPose --seeds 0 1

Finished rows are kept; running it again adds the missing ones.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from pathlib import Path

from hydra import compose, initialize_config_dir

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.synergies import load_bundle

ROOT = Path(__file__).parent.parent
READINGS = ("default", "paper")
FACTS = ("vaf", "pca_vaf", "nmf_vaf", "control_authority", "effective_components", "frames")
ORIGIN = ("commit", "machine", "torch", "torchrl", "mujoco", "myosuite")


def explore(env: str, reading: str, seed: int, frames: int) -> dict[str, object]:
    """Run one exploration; returns its row."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = [
            f"env={env}",
            *(["faithful=paper"] if reading == "paper" else []),
            f"seed={seed}",
            f"explore.frames={frames}",
            "num_synergies=4",
            "stage=explore",
            "pictures=false",
            "threads=1",
            f"run_dir='{folder}/run'",
        ]
        with initialize_config_dir(str(ROOT / "recipes" / "conf"), version_base="1.3"):
            experiment = Experiment(compose("config", overrides=overrides))
        experiment.run()
        facts = load_bundle(experiment.folder.synergies)[1].facts
    row = {"env": env, "reading": reading, "seed": seed, "d": experiment.config.num_synergies}
    return row | {key: facts[key] for key in (*FACTS, *ORIGIN)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandPose")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--frames", type=int, default=16_000)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "synergies.csv")
    arguments = parser.parse_args()
    quiet_torchrl()

    rows: list[dict[str, object]] = []
    if arguments.out.exists():
        with arguments.out.open(newline="") as file:
            rows = list(csv.DictReader(file))
    done = {(row["env"], row["reading"], str(row["seed"])) for row in rows}
    for seed in arguments.seeds:
        for reading in READINGS:
            if (arguments.env, reading, str(seed)) in done:
                continue
            rows.append(explore(arguments.env, reading, seed, arguments.frames))
            print(json.dumps(rows[-1]), flush=True)
            with arguments.out.open("w", newline="") as file:
                writer = csv.DictWriter(file, rows[-1])
                writer.writeheader()
                writer.writerows(rows)


if __name__ == "__main__":
    main()
