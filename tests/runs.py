"""For tests of whole runs: logged numbers to compare, killed runs, and stopped runs."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from pytest import MonkeyPatch

from tests.configs import tiny
from torchrl_etl.experiment import Experiment
from torchrl_etl.training import Interrupted
from torchrl_etl.training.run_folder import RunFolder
from torchrl_etl.training.stage import Stage

WALL_CLOCK = ("frames_per_second", "wall_seconds")


def numbers(run: Path) -> dict[str, str]:
    """Every log and the summary of a run, without wall-clock times and versions."""
    scalars = {
        path.relative_to(run).as_posix(): path.read_text()
        for path in sorted((run / "csv").rglob("*.csv"))
        if path.stem not in WALL_CLOCK
    }
    summary = json.loads((run / "summary.json").read_text())
    for section in (summary, summary.get("synergies", {})):
        for key in ("versions", "commit"):
            section.pop(key, None)
    return {**scalars, "summary": json.dumps(summary)}


def has_saved(run: Path, stage: str) -> bool:
    return any(run.glob(f"checkpoints/{stage}/*/seal.json"))


def killed_when_saved(run: Path, frames: int, *overrides: str) -> None:
    """A tiny run that ends as if killed after its checkpoint at this number of frames."""

    def remember_and_die(self, stage, saved):
        remember(self, stage, saved)
        if saved == frames:
            raise ZeroDivisionError("as good as killed")

    remember = RunFolder.remember_saved
    with MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "remember_saved", remember_and_die)
        with pytest.raises(ZeroDivisionError):
            Experiment(tiny(f"run_dir='{run}'", *overrides)).run()


def stopped(run: Path, *overrides: str, number: int = signal.SIGINT) -> Experiment:
    """A tiny run that gets a stop signal in its seventh batch, saves and ends."""
    experiment = Experiment(tiny(f"run_dir='{run}'", *overrides))
    collect = Stage.collect

    def collect_and_signal(stage):
        batch = collect(stage)
        if stage.frames == 224:
            os.kill(os.getpid(), number)
        return batch

    with MonkeyPatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr(Stage, "collect", collect_and_signal)
        experiment.run()
    return experiment
