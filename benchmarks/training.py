"""Our side of end_to_end.py: training of a stage or plain SAC.

First prints its allocation of cores, after one update. Each input line is a number of seconds. It
trains for these and prints the frames per second.
"""

from __future__ import annotations

import argparse
import json
import sys

import torch
from harness import recipe

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.layout import choose_layout, train_on, training_speed
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.training import Stage


def build(experiment: Experiment, method: str) -> Stage:
    if method == "etl_explore":
        return Explorer(experiment.context).stage
    return experiment.method.stage()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--method", required=True)
    parser.add_argument("--env", required=True)
    parser.add_argument("--frames-per-update", type=int, required=True)
    parser.add_argument("overrides", nargs="*")
    arguments = parser.parse_args()
    quiet_torchrl()
    updates = 1 / arguments.frames_per_update
    overrides = [
        f"env={arguments.env}",
        "run_dir=unused",
        "actor.layer_norm=false",
        f"explore.replay_ratio={updates}",
        f"learn.replay_ratio={updates}",
        *arguments.overrides,
    ]
    method = "sac" if arguments.method == "sac" else "etl"
    config = recipe(*overrides, f"method={method}")
    if config.collector.kind == "auto":
        config = choose_layout(config)
        torch.set_num_threads(config.threads)
    experiment = Experiment(config)
    stage = build(experiment, arguments.method)
    stage.restart_collection()

    while not stage.progress.updates:
        train_on(stage)
    shared = {key: config.collector[key] for key in ("kind", "num_workers")}
    print(json.dumps({**shared, "learner_threads": torch.get_num_threads()}))
    print("ready", flush=True)
    for line in sys.stdin:
        train_on(stage)  # a batch collected while the others ran is not counted
        print(training_speed(stage, float(line)), flush=True)
    stage.close()


if __name__ == "__main__":
    main()
