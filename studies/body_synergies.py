"""Synergies from a body's moment arms: each drives one joint, or a combination of joints.

    python studies/body_synergies.py myoLegWalk runs/body/myoLegWalk

``synergies=body`` starts stage 2 with these (:func:`~torchrl_etl.envs.body_synergies`). This script
writes them to a bundle and prints the share of their variance that turns joints.

There are two controls. ``--shuffle SEED`` permutes the muscles: resting activation, number and
strength of the synergies stay the same, but they no longer match the joints. ``--still`` has one
synergy that moves no muscle, so only the resting activation of a body's synergies remains.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from torchrl.envs import EnvBase

from torchrl_etl.analysis import control_authority, joint_effects
from torchrl_etl.checks import renaming
from torchrl_etl.command_line import exit_on_error, quiet_torchrl
from torchrl_etl.envs import (
    actuator_names,
    body_decoder,
    excitation,
    joint_torques,
    make_env,
    muscle_changes,
    resolve_task,
)
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import save_bundle
from torchrl_etl.training.run_folder import facts


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task")
    parser.add_argument("out", type=Path)
    parser.add_argument("--num-synergies", type=int, help="default: one for each joint")
    parser.add_argument("--rest", type=float, default=0.25, help="activation of coefficients 0")
    control = parser.add_mutually_exclusive_group()
    control.add_argument("--shuffle", type=int, metavar="SEED", help="permute the muscles")
    control.add_argument("--still", action="store_true", help="one synergy that moves no muscle")
    arguments = parser.parse_args()
    quiet_torchrl()
    with exit_on_error(ValueError, OSError):
        env = make_env(arguments.task, seed=0)
        env.reset()
        torques = joint_torques(env)
        with renaming(num_synergies="--num-synergies"):
            changes = muscle_changes(torques.matrix, arguments.num_synergies)
        if arguments.shuffle is not None:
            changes = np.random.default_rng(arguments.shuffle).permutation(changes, axis=1)
        if arguments.still:
            changes = np.zeros_like(changes[:1])
        with renaming(rest="--rest"):
            decoder = body_decoder(env, changes, rest=arguments.rest)
        known = {
            "joint_share": None if arguments.still else joint_share(env, decoder, torques.matrix),
            "control_authority": control_authority(decoder).mean().item(),
            "joints": torques.joints,
            "rest": arguments.rest,
            "shuffle": arguments.shuffle,
            "still": arguments.still,
            "frames": 0,  # no frames are charged: this is a bound
            **facts(),
        }
        save_bundle(
            decoder,
            arguments.out,
            task=resolve_task(arguments.task).env_id,
            actuators=actuator_names(env),
            facts=known,
        )
    print(json.dumps(known))


@torch.no_grad()
def joint_share(env: EnvBase, decoder: SynergyDecoder, torques: np.ndarray) -> float:
    """Share of the variance that turns joints; below 1 because muscles saturate."""
    generator = torch.Generator().manual_seed(0)
    synergies = 2 * torch.rand(4096, decoder.num_synergies, generator=generator) - 1
    return joint_effects(excitation(env, decoder.module(synergies)), torques).share


if __name__ == "__main__":
    main()
