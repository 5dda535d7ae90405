"""Muscle actions of a trained policy, and how far further updates change them.

    python studies/policy_drift.py RUN [RUN ...] --out docs/results/policy_drift.csv

RUN is a run folder with a checkpoint of stage 2, of any method. Actions are scaled to [-1, 1] and
evaluated at 1000 of the newest observations. ``mean_size`` is the root mean square of the mean
action, ``at_bounds`` the share of its entries within 0.001 of a bound, and ``noise`` the standard
deviation of sampled actions. ``drift_K`` is the root mean square change of the mean action after K
more updates on the same transitions. Rows are appended.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from rows import append
from tensordict import TensorDict
from torch import Tensor
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_etl.command_line import exit_on_error
from torchrl_etl.experiment import Experiment
from torchrl_etl.training import resumed_config
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.run_folder import facts
from torchrl_etl.training.stage import Stage

OBSERVATIONS, NEWEST, DRAWS = 1000, 4000, 20
UPDATES = (10, 50, 200, 1000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--out", type=Path, help="CSV file to append to")
    arguments = parser.parse_args()
    for run in arguments.runs:
        with exit_on_error(ValueError, OSError):
            config = resumed_config(run, ["compile=false"])
            experiment = Experiment(config, resume=run)
            stage = experiment.learned()  # or a clear error; the full checkpoint is loaded below
        checkpoints = experiment.folder.checkpoints(stage.name)
        Checkpoints(checkpoints, keep_last=2).load_newest_whole(stage.checkpoint())
        space = experiment.context.spec.action_spec.space
        of_run = json.loads((run / "versions.json").read_text())[-1]["commit"]
        row = {"task": config.env, "method": config.method.name, "seed": config.seed}
        row |= {"frames": stage.frames, "run_commit": of_run, **measured(stage, space)}
        row |= {key: facts()[key] for key in ("commit", "machine")}
        print(json.dumps(row))
        if arguments.out:
            append(arguments.out, row)


def measured(stage: Stage, space: ContinuousBox) -> dict[str, float]:
    torch.manual_seed(0)
    rows = stage.newest(NEWEST)["observation"]
    seen = rows[torch.randperm(len(rows))[:OBSERVATIONS]]
    policy = stage.learner.behavior

    @torch.no_grad()
    def muscles(kind: ExplorationType = ExplorationType.DETERMINISTIC) -> Tensor:
        with set_exploration_type(kind):
            action = policy(TensorDict({"observation": seen}, [len(seen)]))["action"]
        return 2 * (action - space.low) / (space.high - space.low) - 1

    meant = muscles()
    drawn = torch.stack([muscles(ExplorationType.RANDOM) for _ in range(DRAWS)])
    found = {
        "mean_size": size(meant),
        "at_bounds": (meant.abs() > 0.999).float().mean().item(),
        "noise": size(drawn.std(0)),
    }
    made = 0
    for updates in UPDATES:
        for _ in range(updates - made):
            stage.updated.update(stage.samples(1)[0])
        made = updates
        found[f"drift_{updates}"] = size(muscles() - meant)
    return {key: round(value, 4) for key, value in found.items()}


def size(values: Tensor) -> float:
    return values.square().mean().sqrt().item()


if __name__ == "__main__":
    main()
