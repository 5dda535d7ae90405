"""What both stages share: a collector, a buffer, and an update that is owed per frame."""

from __future__ import annotations

import gc
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.checkpoint import Checkpoint, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase

from torchrl_etl.training.buffer_adapter import BufferAdapter

__all__ = ["Progress", "Stage", "entropy_target", "gradient_step"]


class Progress:
    """Counters of a stage, saved with it.

    ``owed`` is the fraction of an update that the frames so far have earned but not yet had.
    """

    def __init__(self) -> None:
        self.frames, self.updates, self.owed, self.episodes = 0, 0, 0.0, 0

    def state_dict(self) -> dict[str, float]:
        return dict(vars(self))

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        vars(self).update(state)


class Stage(ABC):
    """One stage of ETL: collect a batch, keep it, update as often as its frames have earned.

    Args:
        make_env (callable): seed → environment to collect from, transforms included.
        policy (TensorDictModuleBase): acts in it; its weights are shared with the losses.

    Keyword Args:
        frames (int): budget of the stage, in environment frames.
        seed (int): seed of the stage.
        device (torch.device): where networks and buffer live.
        buffer_size (int): transitions to keep; never more than the budget are allocated.
        batch_size (int): transitions in an update.
        frames_per_batch (int): frames collected between updates, over all environments.
        updates_per_frame (float): updates per collected frame.
        learning_starts (int): frames before the first update.
        reward_scale (float): factor on the task's reward as the buffer keeps it.
    """

    name: str

    def __init__(
        self,
        make_env: Callable[[int], EnvBase],
        policy: TensorDictModuleBase,
        *,
        frames: int,
        seed: int,
        device: torch.device,
        buffer_size: int,
        batch_size: int,
        frames_per_batch: int,
        updates_per_frame: float,
        learning_starts: int,
        reward_scale: float,
    ) -> None:
        self.make_env, self.policy, self.seed, self.device = make_env, policy, seed, device
        self.reward_scale = reward_scale
        self.budget, self.frames_per_batch = frames, frames_per_batch
        self.updates_per_frame, self.learning_starts = updates_per_frame, learning_starts
        self.progress = Progress()
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(min(buffer_size, frames + frames_per_batch), device=device),
            batch_size=batch_size,
        )
        self.collector: Collector | None = None

    # What a stage defines -------------------------------------------------------------------

    @abstractmethod
    def transitions(self, batch: TensorDictBase) -> TensorDictBase:
        """The entries of a flat batch that the buffer keeps."""

    @abstractmethod
    def update(self) -> TensorDictBase:
        """One gradient step on every part that this stage trains; returns scalars to log."""

    @abstractmethod
    def parts(self) -> dict[str, Any]:
        """Stateful parts by name (losses, optimizers, statistics) for the checkpoint."""

    # What every stage does -------------------------------------------------------------------

    @property
    def frames(self) -> int:
        return self.progress.frames

    @property
    def finished(self) -> bool:
        return self.frames >= self.budget

    def restart_collection(self) -> None:
        """Build the environments anew, seeded by the frame count.

        A checkpoint cannot hold the inside of a simulator. Starting fresh episodes at every
        checkpoint, in a run that goes on just as in one that was resumed, makes the two equal.
        """
        self.close()
        self.collector = Collector(
            lambda: self.make_env(_mix(self.seed, self.frames)),
            self.policy,
            frames_per_batch=self.frames_per_batch,
            total_frames=-1,
            policy_device=self.device,
            storing_device=self.device,
            trust_policy=True,
            auto_register_policy_transforms=False,
        )
        self._batches = iter(self.collector)

    def collect(self) -> TensorDictBase:
        """Collect one batch into the buffer; returns the whole batch, flat."""
        batch = next(self._batches).reshape(-1)
        self.buffer.extend(self.transitions(batch))
        self.progress.frames += batch.numel()
        self.progress.episodes += int(batch["next", "done"].sum())
        if self.frames > self.learning_starts:
            self.progress.owed += batch.numel() * self.updates_per_frame
        return batch

    def learn(self) -> TensorDictBase | None:
        """The updates that the collected frames have earned; returns their mean scalars."""
        due = int(self.progress.owed)
        self.progress.owed -= due
        self.progress.updates += due
        logs = [self.update().detach() for _ in range(due)]
        return torch.stack(logs).mean(0) if logs else None

    def newest(self, count: int) -> TensorDictBase:
        """Up to ``count`` of the latest transitions, oldest first."""
        rows, writer = self.buffer.storage[:], self.buffer.writer
        if len(rows) == self.buffer.storage.max_size:  # full: the oldest row is the next to go
            rows = torch.cat([rows[writer._cursor :], rows[: writer._cursor]])
        return rows[-count:]

    def checkpoint(self) -> Checkpoint:
        """Everything the stage needs to go on, as a TorchRL checkpoint."""
        checkpoint = Checkpoint(**self.parts(), progress=self.progress, rng=GlobalRNGState())
        return checkpoint.register("buffer", self.buffer, adapter=BufferAdapter())

    def close(self) -> None:
        if self.collector is not None:
            self.collector.shutdown()
            # Simulators hold 100 MB each and sit in reference cycles: do not wait for the
            # garbage collector to come by.
            self.collector = self._batches = None
            gc.collect()


def _mix(seed: int, frames: int) -> int:
    """A seed for the environments of the segment that starts at ``frames``.

    It has its highest bit set, which no evaluation seed has.
    """
    return 2**30 + (seed * 1_000_003 + frames) % 2**30


def entropy_target(action_spec: Bounded, action_std: float | None) -> float | str:
    """Entropy of a Gaussian with ``action_std`` per dimension, in units where the bounds are ±1.

    ``None`` gives SAC's usual minus the number of dimensions ("auto").

    Examples:
        >>> from torchrl.data import Bounded
        >>> round(entropy_target(Bounded(-1, 1, shape=(2,)), action_std=1.0), 3)  # ln(2πe)
        2.838
        >>> round(entropy_target(Bounded(0, 1, shape=(2,)), action_std=1.0), 3)  # half as wide
        1.452
    """
    if action_std is None:
        return "auto"
    half_range = (action_spec.space.high - action_spec.space.low) / 2
    return float((half_range * action_std * math.sqrt(2 * math.pi * math.e)).log().sum())


def gradient_step(optimizer: torch.optim.Optimizer, *losses: Tensor) -> None:
    """One optimizer step on the sum of ``losses``."""
    optimizer.zero_grad(set_to_none=True)
    sum(losses).backward()
    optimizer.step()
