"""Posture errors of a trained policy on Hand Pose: one row per joint and time step.

    python studies/pose_errors.py RUN --out docs/results/pose_errors.csv

RUN is a run folder with a checkpoint of stage 2. The policy acts deterministically in the first
evaluation episode. An error is the joint's angle minus its target, in radians.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_etl.command_line import exit_on_error
from torchrl_etl.envs.simulator import simulator
from torchrl_etl.experiment import Experiment
from torchrl_etl.training import resumed_config
from torchrl_etl.training.evaluation import EVALUATION_SEED
from torchrl_etl.training.run_folder import facts

STEPS = (0, 5, 10, 25, 50, 75, 95)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, help="CSV file to write")
    arguments = parser.parse_args()
    with exit_on_error(ValueError, OSError):
        experiment = Experiment(resumed_config(arguments.run), resume=arguments.run)
        stage = experiment.learned()
    env = experiment.context.make_env()
    hand = simulator(env)
    errors = []
    torch.manual_seed(EVALUATION_SEED)
    env.set_seed(EVALUATION_SEED)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        env.rollout(
            max(STEPS) + 2,  # TorchRL does not call the callback after the last step
            stage.learner.policy,
            callback=lambda *_: errors.append(hand.data.qpos - hand.target_jnt_value),
        )
    known = facts()
    rows = [
        {
            "joint": hand.model.joint(joint).name,
            "step": step,
            "target": round(float(hand.target_jnt_value[joint]), 4),
            "error": round(float(errors[step][joint]), 4),
            "distance": round(float(np.linalg.norm(errors[step])), 4),
            "seed": experiment.config.seed,
            "commit": known["commit"],
            "machine": known["machine"],
        }
        for step in STEPS
        if step < len(errors)
        for joint in range(hand.model.njnt)
    ]
    for step in dict.fromkeys(row["step"] for row in rows):
        of_step = [row for row in rows if row["step"] == step]
        worst = sorted(of_step, key=lambda row: -abs(row["error"]))[:4]
        shown = ", ".join(f"{row['joint']} {row['error']:+.2f}" for row in worst)
        print(f"step {step:3}: distance {of_step[0]['distance']:.2f}; {shown}")
    if arguments.out:
        with arguments.out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
