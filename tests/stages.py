"""Tiny stages with collection started, and checks of what changed in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn

from tests.configs import tiny
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.training import run_alone
from torchrl_etl.training.stage import Stage


def explorer(*overrides):
    """Stage 1 with its exploration and synergy model."""
    found = Explorer(Experiment(tiny("run_dir=unused", *overrides)).context)
    found.stage.restart_collection()
    return found


def learn_stage(decoder=None, *overrides):
    """Stage 2 of ETL."""
    decoder = decoder or SynergyDecoder(2, 16, hidden=(32, 32))
    stage = Experiment(tiny("run_dir=unused", *overrides)).method.learn_stage(decoder)
    stage.restart_collection()
    return stage


def method_stage(method, *overrides):
    """The stage of a method that learns the task."""
    overrides = (f"method={method}", "run_dir=unused", *overrides)
    stage = Experiment(tiny(*overrides)).method.stage()
    stage.restart_collection()
    return stage


def fill(stage, batches: int = 6) -> None:
    for _ in range(batches):
        stage.collect()


def sample(stage: Stage) -> TensorDictBase:
    """A batch [B] from the buffer."""
    return stage.samples(1)[0]


def update(stage: Stage) -> TensorDictBase:
    """One update on a sampled batch; returns scalars to log."""
    return stage.updated.update(sample(stage))


def prepared(stage):
    """A sampled batch, prepared as the losses of the objective read it."""
    return stage.learner.objective.prepare(sample(stage))


def snapshot(module: nn.Module) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in module.state_dict().items()}


def changed(module: nn.Module, before: dict[str, torch.Tensor]) -> bool:
    return any(not torch.equal(value, before[key]) for key, value in module.state_dict().items())


def goes_on_after_a_load(make: Callable[[], Stage], folder: Path) -> bool:
    """Whether a saved stage and another one loaded from it then collect and learn the same."""
    stage, twin = make(), make()
    stage.restart_collection()
    for _ in range(5):
        stage.collect(), run_alone(stage.learn())
    stage.checkpoint().save(folder / "saved")
    rows = []
    for one in (stage, twin):
        one.checkpoint().load(folder / "saved")
        one.restart_collection()
        rows.append([one.collect().select("action", "observation") for _ in range(3)])
        rows[-1].append(update(one))
        one.close()
    return all((ours == theirs).all() for ours, theirs in zip(*rows, strict=True))
