"""Our side of end_to_end.py: a stage, or plain SAC, training as told.

Reads a number of seconds a line, trains for so long, and answers with the frames a second.
"""

from __future__ import annotations

import argparse
import sys
import time

from harness import recipe

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.training import Stage, alone


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
    experiment = Experiment(recipe(*overrides, f"method={method}"))
    stage = build(experiment, arguments.method)
    stage.restart_collection()

    def step() -> None:
        stage.collect()
        alone(stage.learn())

    while not stage.progress.updates:
        step()
    print("ready", flush=True)
    for line in sys.stdin:
        step()  # its frames may have been collected before
        begun, before = time.perf_counter(), stage.frames
        while time.perf_counter() - begun < float(line):
            step()
        print((stage.frames - before) / (time.perf_counter() - begun), flush=True)
    stage.close()


if __name__ == "__main__":
    main()
