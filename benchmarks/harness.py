"""Shared code of the benchmarks: the recipe's sizes, interleaved cases, and JSON lines."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median, quantiles
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from machine import machine
from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential

from torchrl_etl.envs import make_env
from torchrl_etl.modules import SynergyDecoder, make_actor
from torchrl_etl.training import Stage, run_alone
from torchrl_etl.training.run_folder import facts
from torchrl_etl.training.work import Work

__all__ = ["Child", "interleave", "line", "recipe", "spread", "synergy_policy", "train", "training"]

CONF = Path(__file__).resolve().parent.parent / "recipes" / "conf"

# The settings of the published lines, for which ``learner=plain`` alone stood then.
PLAIN = (
    "learner=plain",
    "actor.layer_norm=true",
    "learn.replay_ratio=0.25",
    "learn.reward_scale=0.1",
    "learn.sac.gamma=0.97",
    "learn.sac.alpha_init=0.1",
    "num_synergies=4",
    "learn.decoder.residual=0",
)


def recipe(*overrides: str) -> DictConfig:
    """The configuration of ``recipes/etl_sac.py`` with ``PLAIN`` and these overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=[*PLAIN, *overrides])


def synergy_policy(task: str, num_synergies: int) -> TensorDictSequential:
    """The learn stage's policy under ``PLAIN``: an actor with two layers of 256 with layer norm, a
    decoder with two of 128.
    """
    env = make_env(task)
    bounds = env.full_action_spec_unbatched["action"]
    inputs = {"observation": env.observation_spec["observation"].shape[-1]}
    env.close()
    decoder = SynergyDecoder(
        num_synergies, bounds.shape[-1], low=bounds.space.low, high=bounds.space.high
    )
    actor = make_actor(inputs, decoder.synergy_spec, out_key="synergy", layer_norm=True)
    return TensorDictSequential(actor, decoder)


def training(stage: Stage, updates: int, at_once: int) -> Work[None]:
    """Updates through the training code, as if each batch of frames allowed ``at_once``."""
    for _ in range(max(1, updates // at_once)):
        stage.progress.owed += at_once
        yield from stage.learn()


def train(stage: Stage, updates: int, at_once: int) -> None:
    """Run :func:`training` to its end."""
    run_alone(training(stage, updates, at_once))


class Child:
    """A process that answers each line of input with a line of output."""

    def __init__(self, command: Sequence[str | Path], **options: Any) -> None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, **pipes, **options)

    def answer(self) -> str:
        line = self.process.stdout.readline().strip()
        if not line:
            raise RuntimeError(f"{self.process.args} ended with {self.process.wait()}.")
        return line

    def ask(self, line: object) -> str:
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def interleave(cases: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Measure all cases in turn, for ``repeats`` rounds after an unrecorded first one.

    Other load on the machine then affects all cases alike, and ratios within a round stay valid
    while the measurements themselves drift.
    """
    values: dict[str, list[float]] = {name: [] for name in cases}
    for round_ in range(repeats + 1):
        for name, measure in cases.items():
            value = measure()
            if round_:
                values[name].append(value)
    return values


def spread(values: list[float]) -> float:
    """Half the interquartile range."""
    if len(values) < 2:
        return 0.0
    low, _, high = quantiles(values, n=4, method="inclusive")
    return (high - low) / 2


def line(
    benchmark: str,
    case: str,
    unit: str,
    values: list[float],
    *,
    peers: Mapping[str, list[float]] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Print and return one case: median, spread, and median per-round ratios to ``peers``."""
    row = {
        "benchmark": benchmark,
        "case": case,
        "unit": unit,
        "median": round(median(values), 4),
        "spread": round(spread(values), 4),
        "repeats": len(values),
    }
    others = {name: each for name, each in (peers or {}).items() if each is not values}
    if others:
        row["ratios"] = {name: ratio(values, each) for name, each in others.items()}
    row |= {"threads": torch.get_num_threads(), **more, **machine(), **facts()}
    print(json.dumps(row), flush=True)
    return row


def ratio(values: list[float], others: list[float]) -> list[float]:
    """Median and spread of the per-round ratios of one case to another."""
    ratios = [mine / other for mine, other in zip(values, others, strict=True)]
    return [round(median(ratios), 3), round(spread(ratios), 3)]
