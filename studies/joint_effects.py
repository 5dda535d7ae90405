"""Share of synergies' variance that turns joints; no learning, one CSV row per bundle.

    python studies/joint_effects.py runs/EXPLORED runs/OTHER --out docs/results/joint_effects.csv

RUN is a run folder of ETL. Uniform coefficients of its bundle are decoded to excitations and
compared with the moment arms of its task. ``share``, ``chance`` and ``gain`` are explained in
:func:`~torchrl_etl.analysis.joint_effects`. ``shuffled`` and ``shuffled_sd`` are mean and standard
deviation of the share under random permutations of the muscles, the baseline for a share. The first
run of a task adds three reference rows: uniform actions, as many random directions around the
middle action, and the body's synergies (``studies/body_synergies.py``). Rows are appended.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from rows import append
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etl.analysis import joint_effects
from torchrl_etl.command_line import exit_on_error, quiet_torchrl
from torchrl_etl.envs import body_decoder, excitation, joint_torques, make_env, muscle_changes
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import load_bundle
from torchrl_etl.training import resumed_config
from torchrl_etl.training.run_folder import facts

SAMPLES, SHUFFLES = 4096, 100
REST = 0.25


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--out", type=Path, required=True, help="CSV file to append to")
    arguments = parser.parse_args()
    quiet_torchrl()
    tasks = known_tasks(arguments.out)
    for run in arguments.runs:
        with exit_on_error(ValueError, OSError):
            config = resumed_config(run)
            for row in rows_of(run, config, with_references=config.env not in tasks):
                append(arguments.out, row)
                print(json.dumps(row), flush=True)
        tasks.add(config.env)


def rows_of(run: Path, config: DictConfig, with_references: bool) -> Iterator[dict[str, Any]]:
    """The row of a run's bundle, after the reference rows of its task if asked for."""
    decoder, info = load_bundle(run, residual=0.0)
    env = make_env(config.env, goal=config.goal, seed=0)
    env.reset()
    torques = joint_torques(env).matrix
    actions = {}
    if with_references:
        actions |= references(env, torques, decoder.num_synergies)
    actions["explored"] = decoded(decoder)
    for name, chosen in actions.items():
        excitations = excitation(env, chosen)
        effects = joint_effects(excitations, torques)._asdict() | shuffled(excitations, torques)
        explored = name == "explored"
        yield {
            "task": config.env,
            "synergies": name,
            "extrinsic_weight": config.exploration.bonus.extrinsic_weight if explored else "",
            "seed": config.seed if explored else "",
            "explored_frames": info.facts["frames"] if explored else "",
            **{key: round(value, 4) for key, value in effects.items()},
            "run_commit": info.facts["commit"] if explored else "",
            **{key: facts()[key] for key in ("commit", "machine")},
        }


def references(env: EnvBase, torques: np.ndarray, num_synergies: int) -> dict[str, Tensor]:
    """Reference actions [N, n] that need no exploration."""
    torch.manual_seed(0)
    space = env.full_action_spec_unbatched["action"].space
    middle, half = (space.high + space.low) / 2, (space.high - space.low) / 2
    directions = half * torch.randn(num_synergies, len(half)) / num_synergies**0.5
    random = SynergyDecoder.from_directions(middle, directions, low=space.low, high=space.high)
    return {
        "uniform_actions": middle + half * (2 * torch.rand(SAMPLES, len(half)) - 1),
        "random_directions": decoded(random),
        "body": decoded(body_decoder(env, muscle_changes(torques), rest=REST)),
    }


def shuffled(excitations: Tensor, torques: np.ndarray) -> dict[str, float]:
    """Mean and deviation of the share under random permutations of the muscles."""
    generator = torch.Generator().manual_seed(0)
    orders = [torch.randperm(torques.shape[1], generator=generator) for _ in range(SHUFFLES)]
    shares = [joint_effects(excitations[:, order], torques).share for order in orders]
    return {"shuffled": float(np.mean(shares)), "shuffled_sd": float(np.std(shares))}


@torch.no_grad()
def decoded(decoder: SynergyDecoder) -> Tensor:
    """Decoded actions for uniform coefficients."""
    generator = torch.Generator().manual_seed(0)
    return decoder.module(2 * torch.rand(SAMPLES, decoder.num_synergies, generator=generator) - 1)


def known_tasks(out: Path) -> set[str]:
    if not out.exists():
        return set()
    with out.open(newline="", encoding="utf-8") as file:
        return {row["task"] for row in csv.DictReader(file)}


if __name__ == "__main__":
    main()
