"""Synergies of a policy that has learned a task: the best case for explored ones.

    python studies/learned_synergies.py runs/SAC_RUN learned/hand_pose --num-synergies 8

Samples episodes with the EMA actor of a plain SAC run, and fits a GMVAE, or principal components
before the bounds (``--model pca``), to the mean actions in the visited states. The resulting bundle
starts stage 2 like any other (``synergies=learned/hand_pose``), on the same task or on another one
with the same muscles. Its facts include the return of the policy.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_etl.analysis import variance_accounted_for
from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.synergies import fit_synergies
from torchrl_etl.training import resumed_config
from torchrl_etl.training.run_folder import facts

EPISODES = 50
UPDATES = 4000
HIDDEN = (128, 128)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--num-synergies", type=int, default=8)
    parser.add_argument("--model", choices=["gmvae", "pca"], default="gmvae")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    quiet_torchrl()
    torch.manual_seed(arguments.seed)

    config = resumed_config(arguments.run, ["evaluation.episodes=1"])
    if config.method.kind != "sac":
        parser.error(f"{arguments.run} is a run of {config.method.name}; pass one of method=sac.")
    experiment = Experiment(config, resume=arguments.run)
    stage = experiment.learned()
    found = experiment.evaluator(stage)().mean_return.mean
    env, actions = experiment.context.make_env(), []
    env.set_seed(arguments.seed)
    with torch.no_grad():
        for _ in range(EPISODES):
            with set_exploration_type(ExplorationType.RANDOM):
                rollout = env.rollout(1000, stage.learner.policy)
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                actions.append(stage.learner.policy(rollout.select("observation"))["action"])
    shown = torch.cat(actions)

    space = experiment.context.spec
    options = {} if arguments.model == "pca" else {"updates": UPDATES, "hidden": HIDDEN}
    bounds = {"low": space.low, "high": space.high}
    model = fit_synergies(shown, arguments.model, arguments.num_synergies, **bounds, **options)
    with torch.no_grad():
        vaf = variance_accounted_for(shown, model.reconstruct(shown))
    known = {
        "vaf": vaf,
        "model": arguments.model,
        "return_of_policy": found,
        "frames": 0,  # no frames are charged: this is a bound
        **facts(),
    }
    names = experiment.context.spec.actuators
    model.save(arguments.out, shown, task=experiment.task.env_id, actuators=names, facts=known)
    print(json.dumps(known))


if __name__ == "__main__":
    main()
