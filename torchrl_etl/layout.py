"""Which processes collect and how many threads learn, chosen by what both take on this machine."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import torch

from torchrl_etl.experiment import Experiment

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from torchrl_etl.training import Stage

__all__ = ["Layout", "choose_layout", "layouts"]

CLEARLY_FASTER = 1.1  # what another process must promise to be worth it


class Layout(NamedTuple):
    """Workers that collect (0: the learner's process does), threads that learn, and what to expect.

    Attributes:
        num_workers (int): processes of their own, one batch ahead of the learner.
        threads (int): of PyTorch in the learner's process.
        frames_per_second (float): of both together.
    """

    num_workers: int
    threads: int
    frames_per_second: float


def choose_layout(
    config: DictConfig, *, seconds: float = 0.5, say: Callable[[str], None] = lambda line: None
) -> DictConfig:
    """The configuration with ``collector.kind=auto`` and ``threads`` settled for this machine.

    Collects and learns with the run's own networks and simulators, a moment each, and reckons with
    :func:`layouts` what they do together. Updates are measured uncompiled. A ``threads`` that is
    given is kept. What is chosen belongs to the run: it is saved with its configuration.

    Args:
        config (DictConfig): see ``recipes/conf/config.yaml``.

    Keyword Args:
        seconds (float): for each measurement. Default: 0.5.
        say (callable): told in one line what was chosen and why.

    Raises:
        ValueError: if the configuration is not one that can run, or asks for several seeds, which
            would be measured as one.
    """
    if config.seeds is not None:
        raise ValueError(
            "collector=auto measures one run but seeds asks for several at once; choose "
            "collector=process."
        )
    config, trial = config.copy(), config.copy()
    trial.collector.kind, trial.collector.ahead, trial.compile = "single", False, False
    trial.learn.buffer_storage, trial.learn.buffer_size = "memory", 4096
    cores = available_cores()
    workers = [2**power for power in range(cores.bit_length()) if 2**power < cores]
    batch, num_envs = config.collector.frames_per_batch, config.collector.num_envs
    workers = [number for number in workers if batch % (number * num_envs) == 0]
    threads = {0: config.threads or cores}
    threads |= {number: config.threads or cores - number for number in workers}

    stage = Experiment(trial).method.stage()
    try:
        frame = seconds_a_frame(stage, seconds)
        update = seconds_an_update(stage, seconds, set(threads.values()))
    finally:
        stage.close()
    found = layouts(frame, update, threads, stage.replay_ratio)
    fastest = max(found, key=lambda layout: layout.frames_per_second)
    in_process = found[0]
    if fastest.frames_per_second < CLEARLY_FASTER * in_process.frames_per_second:
        fastest = in_process

    config.threads = fastest.threads
    collector = config.collector
    collector.kind = "process" if fastest.num_workers else "single"
    collector.ahead, collector.num_workers = fastest.num_workers > 0, max(1, fastest.num_workers)
    took = ", ".join(f"{1e3 * update[n]:.3g} ms with {n} thread(s)" for n in sorted(update))
    say(
        f"collector=auto: {collector.kind}, num_workers={collector.num_workers}, "
        f"threads={config.threads} (a frame takes {1e3 * frame:.2g} ms, an update {took}, "
        f"uncompiled; {fastest.frames_per_second:.0f} frames/s, in one process "
        f"{in_process.frames_per_second:.0f})"
    )
    return config


def layouts(
    frame: float, update: Mapping[int, float], threads: Mapping[int, int], replay_ratio: float
) -> list[Layout]:
    """What to expect of each way to share the cores.

    In one process collecting and learning take turns; workers collect while the learner learns, so
    that the slower of the two counts.

    Args:
        frame (float): seconds to collect a frame.
        update (mapping): seconds of an update, by threads.
        threads (mapping): threads that learn beside so many workers.
        replay_ratio (float): updates a frame.

    Examples:
        >>> layouts(0.001, {1: 0.012, 2: 0.008}, {0: 2, 1: 1}, replay_ratio=1.0)[0].num_workers
        0
        >>> [round(each.frames_per_second) for each in
        ...  layouts(0.001, {1: 0.012, 2: 0.008}, {0: 2, 1: 1}, replay_ratio=1.0)]
        [111, 83]
        >>> [round(each.frames_per_second) for each in
        ...  layouts(0.001, {1: 0.012, 2: 0.008}, {0: 2, 1: 1}, replay_ratio=0.0625)]
        [667, 1000]
    """
    found = []
    for workers, count in threads.items():
        learning = replay_ratio * update[count]
        seconds = max(frame / workers, learning) if workers else frame + learning
        found.append(Layout(workers, count, 1 / seconds))
    return found


def available_cores() -> int:
    """Cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def seconds_a_frame(stage: Stage, seconds: float) -> float:
    """What it takes to collect one in this process, policy and transforms included."""
    stage.restart_collection()
    while len(stage.buffer) < 2:  # the first call builds what later ones use; n steps hold back
        before = stage.frames
        stage.collect()
    return seconds_a_call(stage.collect, seconds) / (stage.frames - before)


def seconds_an_update(stage: Stage, seconds: float, threads: Iterable[int]) -> dict[int, float]:
    """What an update takes, by threads."""
    taken, before = {}, torch.get_num_threads()
    try:
        for count in threads:
            torch.set_num_threads(count)
            stage.update()
            taken[count] = seconds_a_call(stage.update, seconds)
    finally:
        torch.set_num_threads(before)
    return taken


def seconds_a_call(call: Callable[[], object], seconds: float) -> float:
    """The median of as many calls as fit: other processes must not decide."""
    taken: list[float] = []
    while sum(taken) < seconds or len(taken) < 3:
        begun = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begun)
    return median(taken)
