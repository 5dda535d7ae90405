"""Our side of ``end_to_end.py``: a stage, or plain SAC, training in steps as told.

Reads a number of frames a line, trains for so many, and answers with the seconds that this took.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from harness import recipe
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.modules import make_actor, make_critic
from torchrl_etl.objectives import LeanSACLoss
from torchrl_etl.training import Experiment
from torchrl_etl.training.stage import Stage, make_optimizer, ready_for_training


class SACStage(Stage):
    """Plain SAC on all actuators, in the loop of ETL's stages."""

    name = "sac"

    def __init__(self, make_env: Any, spec: Any, *, network: Any, sac: Any, **stage: Any) -> None:
        action_spec = spec.full_action_spec_unbatched["action"]
        inputs = {"observation": spec.observation_spec["observation"].shape[-1]}
        actor = make_actor(inputs, action_spec, **network)
        critic = make_critic({**inputs, "action": action_spec.shape[-1]}, **network)
        super().__init__(make_env, actor, **stage)
        self.sac = LeanSACLoss(actor, critic, action_spec=action_spec, alpha_init=sac["alpha_init"])
        self.targets = [ready_for_training(self.sac, gamma=sac["gamma"], tau=sac["tau"])]
        self.optimizer = make_optimizer(self.device, (self.sac.parameters(), sac["lr"]))

    def transitions(self, batch: TensorDictBase) -> TensorDictBase:
        kept = batch.select("observation", "action", ("next", "observation"))
        kept["next"].update(batch["next"].select("done", "terminated"))
        kept["next", "reward"] = self.reward_scale * batch["next", "reward"]
        return kept

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        sac = self.sac(batch)
        return sac["loss_actor"] + sac["loss_qvalue"] + sac["loss_alpha"], sac

    def parts(self) -> dict[str, Any]:
        return {"sac": self.sac, "optimizer": self.optimizer}


def build(experiment: Experiment, method: str) -> Stage:
    if method == "etl_explore":
        return experiment.explore_stage()
    if method == "etl_learn":
        return experiment.learn_stage(experiment.blank_decoder())
    options = experiment._options("learn")
    for name in ("fine_tuning", "decoder_lr", "anchor"):
        options.pop(name)
    return SACStage(
        experiment._env_maker(), experiment.spec, seed=0, device=experiment.device, **options
    )


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
        "network.layer_norm=false",
        f"explore.updates_per_frame={updates}",
        f"learn.updates_per_frame={updates}",
        *arguments.overrides,
    ]
    experiment = Experiment(recipe(*overrides))
    stage = build(experiment, arguments.method)
    stage.restart_collection()

    def train(frames: int) -> None:
        goal = stage.frames + frames
        while stage.frames < goal:
            stage.collect()
            stage.learn()

    train(1000)
    print("ready", flush=True)
    for line in sys.stdin:
        begun = time.perf_counter()
        train(int(line))
        print(time.perf_counter() - begun, flush=True)
    stage.close()


if __name__ == "__main__":
    main()
