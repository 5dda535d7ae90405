"""Which processes collect and how many threads learn: tried out before a run begins."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch

from torchrl_etl.experiment import Experiment
from torchrl_etl.training import alone

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from torchrl_etl.training import Stage

__all__ = ["Layout", "choose_layout", "layouts", "train_on", "training_speed"]

CLEARLY_FASTER = 1.05  # what processes of their own must gain to be worth it


class Layout(NamedTuple):
    """A way to share the cores.

    Attributes:
        num_workers (int): processes that collect; 0: the learner's process does.
        threads (int): of PyTorch in the learner's process.
        ahead (bool): workers collect a batch while the learner learns on the last; else they take
            turns.
    """

    num_workers: int
    threads: int
    ahead: bool = True

    @property
    def collector(self) -> dict[str, str | int | bool]:
        """What the configuration's section of this name says then."""
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
    """The configuration with ``collector.kind=auto`` and ``threads`` settled for this machine.

    Trains with the run's own networks, simulators and replay ratio in each of :func:`layouts` for
    a moment, compiled if the run will be, and takes the fastest. Nothing of that training is kept:
    the run is the one that the chosen settings give. They are saved with its configuration.

    Args:
        config (DictConfig): see ``recipes/conf/config.yaml``. A number of threads that it gives is
            kept.

    Keyword Args:
        seconds (float): to train in each. Default: 2.
        say (callable): told in one line what was measured and chosen.

    Raises:
        ValueError: if the configuration is not one that can run, or asks for several seeds, which
            would be measured as one.
    """
    if config.seeds is not None:
        raise ValueError(
            "collector=auto tries out one run but seeds asks for several at once; choose "
            "collector=process."
        )
    per_worker, batch = config.collector.num_envs, config.collector.frames_per_batch
    candidates = layouts(available_cores(), batch // per_worker, config.threads)
    trial = config.copy()
    trial.collector.update(candidates[0].collector)
    trial.learn.update({"buffer_storage": "memory", "buffer_size": 4096, "learning_starts": 0})
    before, stage = torch.get_num_threads(), Experiment(trial).method.stage()
    try:
        speeds = {each: frames_per_second(stage, each, seconds) for each in candidates}
    finally:
        stage.close()
        torch.set_num_threads(before)
    best = max(speeds, key=speeds.get)
    if speeds[best] < CLEARLY_FASTER * speeds[candidates[0]]:
        best = candidates[0]
    found = "; ".join(f"{each}: {speed:.0f}" for each, speed in speeds.items())
    say(f"collector=auto takes {best} (frames/s: {found})")
    chosen = config.copy()
    chosen.threads = best.threads
    chosen.collector.update(best.collector)
    return chosen


def layouts(cores: int, most_workers: int, threads: int | None = None) -> list[Layout]:
    """Ways to share so many cores, that of one process first.

    Beside workers the learner has the cores that they leave, or all: workers that are ahead wait.
    As many workers as there are cores take turns with a learner that has them all.

    Args:
        cores (int): cores of the machine.
        most_workers (int): workers that can share a batch; a power of two of them does.
        threads (int, optional): of the learner in all of them.

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
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def frames_per_second(stage: Stage, layout: Layout, seconds: float) -> float:
    """How fast a stage trains in a layout."""
    torch.set_num_threads(layout.threads)
    stage.collect_from(**layout.collector)
    stage.restart_collection()
    return training_speed(stage, seconds)


def train_on(stage: Stage) -> None:
    """Collect a batch, and make the updates that it has earned."""
    stage.collect()
    alone(stage.learn())


def training_speed(stage: Stage, seconds: float) -> float:
    """Frames a second of a stage as it is."""
    train_on(stage)  # compiles; its frames may have been collected before
    begun, before = time.perf_counter(), stage.frames
    while time.perf_counter() - begun < seconds or stage.frames == before:
        train_on(stage)
    return (stage.frames - before) / (time.perf_counter() - begun)
