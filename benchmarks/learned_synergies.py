"""Synergies of a policy that has learned a task: what explored ones could be at best.

    python benchmarks/learned_synergies.py runs/SAC_RUN learned/hand_pose --num-synergies 8

Takes the averaged actor of a run of plain SAC, lets it act with its noise, and fits a GMVAE, or
principal components before the bounds (``--model pca``), on the mean actions in the states that it
meets. The bundle that this leaves starts stage 2 as any other (``synergies=learned/hand_pose``), on
the same task or on another one of the same muscles; its facts say how good the policy was.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_etl.analysis import pca_vaf, variance_accounted_for
from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.envs import EnvironmentSpec
from torchrl_etl.experiment import Experiment
from torchrl_etl.modules import GMVAE, SynergyDecoder
from torchrl_etl.modules.bundle import save_bundle
from torchrl_etl.synergies import fit_gmvae
from torchrl_etl.training import resumed_config
from torchrl_etl.training.run_folder import facts

EPISODES = 50
UPDATES = 4000
# Where the bounds are ±1: as far as a muscle counts as inside of them.
NEAREST = 0.99


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
    if config.method.learner != "sac":
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

    if arguments.model == "pca":
        decoder = principal_directions(shown, arguments.num_synergies, experiment.context.spec)
        vaf, components = pca_vaf(shown, arguments.num_synergies), None
    else:
        gmvae = GMVAE.from_spec(
            experiment.context.spec.action_spec,
            arguments.num_synergies,
            num_components=arguments.num_synergies,
            hidden=config.synergies.hidden,
        )
        fit_gmvae(gmvae, shown, updates=UPDATES)
        decoder = SynergyDecoder.from_gmvae(gmvae, shown)
        vaf = variance_accounted_for(shown, gmvae.reconstruct(shown).detach())
        components = gmvae.num_components
    known = {
        "vaf": vaf,
        "model": arguments.model,
        "return_of_policy": found,
        "frames": 0,  # nothing is charged: this is a bound
        **facts(),
    }
    save_bundle(
        decoder,
        arguments.out,
        task=experiment.task.env_id,
        actuators=experiment.context.spec.actuators,
        num_components=components,
        facts=known,
    )
    print(json.dumps(known))


def principal_directions(
    actions: Tensor, num_synergies: int, spec: EnvironmentSpec
) -> SynergyDecoder:
    """The mean action, and the directions in which actions vary most, before the bounds.

    As with a GMVAE the box of coefficients spans the 1st to the 99th percentile of each.
    """
    space = spec.action_spec.space
    middle, half = (space.high + space.low) / 2, (space.high - space.low) / 2
    inner = ((actions - middle) / half).clamp(-NEAREST, NEAREST).atanh()
    center = inner.mean(0)
    basis = torch.linalg.svd(inner - center, full_matrices=False).Vh[:num_synergies]
    ends = ((inner - center) @ basis.mT).quantile(torch.tensor([0.01, 0.99]), dim=0)
    unit = (center + ends.mean(0) @ basis).tanh()
    directions = (ends[1] - ends[0])[:, None] / 2 * basis * (1 - unit.square())
    return SynergyDecoder.from_directions(
        middle + half * unit, half * directions, low=space.low, high=space.high
    )


if __name__ == "__main__":
    main()
