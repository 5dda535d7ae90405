"""Synergies that follow from a body alone: each is the torque of one joint, or of several together.

    python studies/body_synergies.py myoLegWalk runs/body/myoLegWalk

The bundle that this leaves starts stage 2 as any other (``synergies=runs/body/myoLegWalk``). Its
decoder is affine before the bounds (:meth:`SynergyDecoder.from_directions`), so nothing is fitted.
Coefficients of 0 hold every muscle at the activation ``--rest``. A coefficient of 1 alone adds the
torque of its joint, by the pseudo-inverse of moment arms times peak forces around the posture after
a reset: the muscle that pulls most for it comes to about full activation, its opponents to none.
Nothing was explored for it: it is a bound for what exploration could find about the body.

``--shuffle SEED`` lets the muscles change places, a control: the same activation at rest, as many
synergies of the same strength, and no sense in them.

With ``--num-synergies`` below the number of joints synergies are the combinations of joints that
muscles turn most, by their singular values, each joint in units of what its muscles can do.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etl.analysis import control_authority, joint_effects
from torchrl_etl.command_line import one_sentence, quiet_torchrl
from torchrl_etl.envs import actuator_names, excitation, joint_torques, make_env, resolve_task
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import save_bundle
from torchrl_etl.training.run_folder import facts

# Combinations of joints that muscles turn less than so much, beside the one they turn most, would
# take all of their strength.
WEAKEST = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task")
    parser.add_argument("out", type=Path)
    parser.add_argument("--num-synergies", type=int, help="default: one for each joint")
    parser.add_argument("--rest", type=float, default=0.25, help="activation of coefficients 0")
    parser.add_argument("--shuffle", type=int, metavar="SEED", help="let muscles change places")
    arguments = parser.parse_args()
    quiet_torchrl()
    with one_sentence(ValueError, OSError):
        env = make_env(arguments.task, seed=0)
        env.reset()
        torques = joint_torques(env)
        changes = muscle_changes(torques.matrix, arguments.num_synergies)
        if arguments.shuffle is not None:
            changes = np.random.default_rng(arguments.shuffle).permutation(changes, axis=1)
        decoder = body_decoder(env, changes, arguments.rest)
        known = {
            "joint_share": joint_share(env, decoder, torques.matrix),
            "control_authority": control_authority(decoder).mean().item(),
            "joints": torques.joints,
            "rest": arguments.rest,
            "shuffle": arguments.shuffle,
            "frames": 0,  # nothing is charged: this is a bound
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


def muscle_changes(torques: np.ndarray, num_synergies: int | None = None) -> np.ndarray:
    """Changes of activation [d, n] that turn one joint each, or one combination of joints.

    Args:
        torques (array): of each fully active muscle on each joint [J, n].
        num_synergies (int, optional): d, at most J; with all J, synergy i turns joint i alone.

    Returns:
        array: the largest change of each row is 1.
    """
    joints = len(torques)
    if num_synergies is not None and not 1 <= num_synergies <= joints:
        raise ValueError(
            f"--num-synergies is {num_synergies}, but muscles turn {joints} joints; give 1 to "
            f"{joints}, or leave it out for one each."
        )
    unit = torques / np.linalg.norm(torques, axis=1, keepdims=True)
    inverse = np.linalg.pinv(unit, rcond=WEAKEST).T
    if num_synergies is not None and num_synergies < joints:
        inverse = np.linalg.svd(unit)[0][:, :num_synergies].T @ inverse
    return inverse / np.abs(inverse).max(1, keepdims=True)


def body_decoder(env: EnvBase, changes: np.ndarray, rest: float) -> SynergyDecoder:
    """Decodes coefficients into actions whose excitations leave ``rest`` by changes [d, n]."""
    if not 0 < rest < 1:
        raise ValueError(f"--rest is {rest}; an activation that can change lies between 0 and 1.")
    bounds = env.full_action_spec_unbatched["action"].space
    center, slope = action_of(env, rest, bounds.low, bounds.high)
    return SynergyDecoder.from_directions(
        center, torch.from_numpy(changes).float() / slope, low=bounds.low, high=bounds.high
    )


def action_of(env: EnvBase, rest: float, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The action [n] whose excitation is ``rest``, and how fast excitation grows there [n]."""
    low, high = low.clone().double(), high.clone().double()
    if not ((excitation(env, low) < rest) & (rest < excitation(env, high))).all():
        raise ValueError(f"--rest is {rest}, and no action inside the bounds makes that.")
    for _ in range(60):  # it is increasing: halve the interval
        middle = (low + high) / 2
        below = excitation(env, middle) < rest
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    center = ((low + high) / 2).requires_grad_()
    (slope,) = torch.autograd.grad(excitation(env, center).sum(), center)
    return center.detach().float(), slope.float()


@torch.no_grad()
def joint_share(env: EnvBase, decoder: SynergyDecoder, torques: np.ndarray) -> float:
    """Share of the variance that turns joints; what is missing to 1 is where muscles saturate."""
    generator = torch.Generator().manual_seed(0)
    synergies = 2 * torch.rand(4096, decoder.num_synergies, generator=generator) - 1
    return joint_effects(excitation(env, decoder.module(synergies)), torques).share


if __name__ == "__main__":
    main()
