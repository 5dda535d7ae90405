"""Chooses the number of collector workers and learner threads by a short benchmark."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from torchrl_etl.experiment import Experiment
from torchrl_etl.training import run_alone

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from torchrl_etl.training import Stage

__all__ = ["Layout", "choose_layout", "layouts", "train_on", "training_speed"]

CLEARLY_FASTER = 1.05  # required speedup of worker processes over a single process
PERIODS = 8  # of a trial, whose lower quartile is compared


class Layout(NamedTuple):
    """An allocation of the cores.

    Attributes:
        num_workers (int): number of collector processes; with 0, the learner's process collects.
        threads (int): PyTorch threads of the learner's process.
        ahead (bool): whether workers collect the next batch while the learner updates; otherwise
            they take turns.
    """

    num_workers: int
    threads: int
    ahead: bool = True

    @property
    def collector(self) -> dict[str, str | int | bool]:
        """Settings for the configuration's section ``collector``."""
        kind, workers = ("process", self.num_workers) if self.num_workers else ("single", 1)
        return {"kind": kind, "num_workers": workers, "ahead": self.num_workers > 0 and self.ahead}

    def __str__(self) -> str:
        in_turn = "" if self.ahead else "in turn, "
        workers = f"{self.num_workers} worker{'s' * (self.num_workers > 1)}, {in_turn}"
        kind = "process, " + workers if self.num_workers else "single, "
        return f"{kind}{self.threads} thread{'s' * (self.threads > 1)}"


def choose_layout(
    config: DictConfig, *, seconds: float = 2.0, say: Callable[[str], None] = lambda line: None
) -> DictConfig:
    """A copy of the configuration with ``collector.kind=auto`` and ``threads`` resolved.

    Trains for a few seconds in each of :func:`layouts`, with the run's networks, simulators,
    replay ratio and compilation, and takes the fastest. Nothing of this training is kept: the
    run is the same as with the chosen settings given. They are saved with its configuration.

    Args:
        config (DictConfig): see ``recipes/conf/config.yaml``. If it sets ``threads``, this is kept.

    Keyword Args:
        seconds (float): training time in each. Default: 2.
        say (callable): called with one line before the trials and one on the outcome.

    Raises:
        ValueError: if the configuration is invalid or asks for several seeds.
    """
    if config.seeds is not None:
        raise ValueError(
            "collector=auto measures one run but seeds asks for several; choose collector=process."
        )
    per_worker, batch = config.collector.num_envs, config.collector.frames_per_batch
    candidates = layouts(available_cores(), batch // per_worker, config.threads)
    say(f"collector=auto tries {len(candidates)} ways to share the cores, each for {seconds:g} s")
    trial = config.copy()
    trial.collector.update(candidates[0].collector)
    trial.learn.update({"buffer_storage": "memory", "buffer_size": 4096, "learning_starts": 0})
    before, stage = torch.get_num_threads(), Experiment(trial).method.stage()
    try:
        speeds = {each: frames_per_second(stage, each, seconds) for each in candidates}
    finally:
        stage.close()
        torch.set_num_threads(before)
    best = max(speeds, key=speeds.__getitem__)
    if speeds[best] < CLEARLY_FASTER * speeds[candidates[0]]:
        best = candidates[0]
    found = "; ".join(f"{each}: {speed:.0f}" for each, speed in speeds.items())
    say(f"collector=auto chose {best} (frames/s: {found})")
    chosen = config.copy()
    chosen.threads = best.threads
    chosen.collector.update(best.collector)
    return chosen


def layouts(cores: int, most_workers: int, threads: int | None = None) -> list[Layout]:
    """Candidate allocations of ``cores``, the single process first.

    With workers ahead, the learner gets the remaining cores, or all, since such workers also wait.
    In the last candidate, a maximal number of workers takes turns with a learner on all cores.

    Args:
        cores (int): cores of the machine.
        most_workers (int): maximal number of workers; candidates are powers of two dividing it.
        threads (int, optional): fixes the learner's threads.

    Examples:
        >>> for layout in layouts(2, most_workers=8):
        ...     print(layout)
        single, 2 threads
        process, 1 worker, 1 thread
        process, 1 worker, 2 threads
        process, 2 workers, in turn, 2 threads
    """
    found = [Layout(0, threads or cores)]
    shares = [2**i for i in range(cores.bit_length()) if most_workers % 2**i == 0]
    for workers in shares:
        if workers < cores:
            left = [threads] if threads else [cores - workers, cores]
            found += [Layout(workers, count) for count in left]
    if cores > 1:
        found.append(Layout(shares[-1], threads or cores, ahead=False))
    return found


def available_cores() -> int:
    """Number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def frames_per_second(stage: Stage, layout: Layout, seconds: float) -> float:
    """Training speed that a stage sustains in a layout: the lower quartile over short periods.

    Threads of a learner wait for each other, so that any other load on the machine slows down some
    layouts up to twofold and others hardly. A mean over a quiet moment would prefer the former.
    """
    torch.set_num_threads(layout.threads)
    stage.collect_from(**layout.collector)
    stage.restart_collection()
    train_on(stage)  # compiles; the batch may have been collected ahead of time
    speeds: list[float] = []
    end = time.perf_counter() + seconds
    while not speeds or time.perf_counter() < end:
        speeds.append(training_speed(stage, seconds / PERIODS))
    return float(np.quantile(speeds, 0.25))


def train_on(stage: Stage) -> None:
    """Collect a batch and make its updates."""
    stage.collect()
    run_alone(stage.learn())


def training_speed(stage: Stage, seconds: float) -> float:
    """Frames per second of a stage in its current layout."""
    begun, before = time.perf_counter(), stage.frames
    while time.perf_counter() - begun < seconds or stage.frames == before:
        train_on(stage)
    return (stage.frames - before) / (time.perf_counter() - begun)
