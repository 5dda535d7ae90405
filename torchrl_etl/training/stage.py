"""A stage of a run: a collector fills a buffer, a learner draws batches from it."""

from __future__ import annotations

import gc
import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn
from torchrl.checkpoint import Checkpoint, GlobalRNGState
from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform

from torchrl_etl.checks import check_choice, check_integer, check_real
from torchrl_etl.collectors import Batches, CollectionError, make_batches
from torchrl_etl.collectors.remote import training_seed
from torchrl_etl.learners import SACLearner
from torchrl_etl.training.buffer_adapter import BufferAdapter
from torchrl_etl.training.continued_multi_step import ContinuedMultiStep
from torchrl_etl.training.storage import make_storage
from torchrl_etl.training.work import Due, Work

__all__ = ["Progress", "Stage"]

TRANSITION = (
    "observation",
    "action",
    *(("next", key) for key in ("observation", "reward", "done", "terminated")),
)


AT_ONCE = {"cpu": 16, "cuda": 64}
"""Batches that are read from the buffer in one go; more cost a CPU its caches, fewer leave a GPU
waiting."""


class Progress:
    """Counters of a stage, saved with it.

    ``owed`` is the number of updates that the frames so far have earned but not yet had;
    ``seconds`` is the wall time that the stage took, over all its starts.
    """

    def __init__(self) -> None:
        self.frames, self.updates, self.owed, self.episodes = 0, 0, 0.0, 0
        self.seconds = 0.0

    def state_dict(self) -> dict[str, float]:
        return dict(vars(self))

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        vars(self).update(state)


class Stage:
    """Collects with a learner's behavior policy and updates it as often as its frames have earned.

    Args:
        name (str): of its logs and its checkpoints.
        learner (SACLearner): what learns; its ``behavior`` collects.
        make_env (callable): environment to collect from, transforms included.

    Keyword Args:
        frames (int): budget of the stage, in environment frames.
        seed (int): seed of the stage.
        device (torch.device): where the buffer lives.
        scratch (path): folder for the files of a ``"memmap"`` buffer; they are deleted when the
            stage is closed.
        collector (mapping): arguments of :func:`~torchrl_etl.collectors.make_batches`.
        buffer_size (int): transitions to keep, 2 or more; never more than the budget are allocated.
        buffer_storage (str): "memory" keeps them on the device, "memmap" in files.
        batch_size (int): transitions in an update, 2 or more.
        replay_ratio (float): updates per frame, up to 1,000.
        learning_starts (int): frames before the first update.
        reward_scale (float): factor on the task's reward, before anything else reads it.
        n_steps (int): rewards in a critic's target before it bootstraps, fewer at the end of an
            episode. Intermediate steps get no entropy bonus. Default: 1.
        keep (sequence of NestedKey): further entries of a transition for the buffer.
        transforms (sequence of Transform): what sampled rows, those of many updates at once, go
            through; what depends on the updates before it is among the learner's ``transforms``.
        updated (SACLearner, optional): what is updated. Default: ``learner``.
        prefill_size (int): transitions to make room for beside the budget. Default: 0.
        action_repeat (int): frames that a transition of the collector takes. Default: 1.
        restart_seed (int): another one collects other episodes with the same ``seed``, so that a
            run whose simulation diverges can go on from its checkpoint. Default: 0.

    Raises:
        ValueError: naming the argument that cannot be used.
    """

    def __init__(
        self,
        name: str,
        learner: SACLearner,
        make_env: Callable[[], EnvBase],
        *,
        frames: int,
        seed: int,
        device: torch.device,
        scratch: Path,
        collector: Mapping[str, Any],
        buffer_size: int,
        buffer_storage: Literal["memory", "memmap"],
        batch_size: int,
        replay_ratio: float,
        learning_starts: int,
        reward_scale: float,
        n_steps: int = 1,
        keep: Sequence[NestedKey] = (),
        transforms: Sequence[Transform] = (),
        updated: SACLearner | None = None,
        prefill_size: int = 0,
        action_repeat: int = 1,
        restart_seed: int = 0,
    ) -> None:
        check_budget(frames, replay_ratio)
        check_integer(1, n_steps=n_steps)
        check_integer(2, batch_size=batch_size, buffer_size=buffer_size)
        check_integer(0, learning_starts=learning_starts)
        check_real("(0, inf)", reward_scale=reward_scale)
        check_choice("buffer_storage", buffer_storage, ("memory", "memmap"))
        self.name, self.learner, self.seed, self.device = name, learner, seed, device
        self.budget, self.action_repeat, self.reward_scale = frames, action_repeat, reward_scale
        self.batch_size, self.replay_ratio = batch_size, replay_ratio
        self.learning_starts, self.restart_seed = learning_starts, restart_seed
        self.updated = learner if updated is None else updated
        self.progress = Progress()
        self.batches: Batches | None = None
        acting = {"make_env": make_env, "policy": learner.behavior, "device": device}
        self._make_batches = partial(make_batches, **collector, **acting)
        per_batch = collector["frames_per_batch"]
        self._frames_per_action = frames_per_action(collector, action_repeat)
        self._most_updates = math.ceil(2 * replay_ratio * action_repeat * per_batch)
        room = min(buffer_size, prefill_size + frames // action_repeat + per_batch)
        storage = make_storage(room, device, scratch / name if buffer_storage == "memmap" else None)
        self.buffer = TensorDictReplayBuffer(storage=storage, transform=Compose(*transforms))
        self.transforms = nn.ModuleList(transforms)
        self._kept = [*TRANSITION, *keep]
        self.multi_step = None
        if n_steps > 1:
            self.multi_step = ContinuedMultiStep(learner.gamma, n_steps)
            self._kept.append("steps_to_next_obs")

    @property
    def frames(self) -> int:
        return self.progress.frames

    @property
    def finished(self) -> bool:
        return self.frames >= self.budget

    def ask(self) -> None:
        """Let workers begin with the next batch, by the policy as it is."""
        self.batches.ask()

    def collect(self) -> TensorDictBase:
        """Collect one batch into the buffer; returns the whole batch, flat."""
        batch = self.batches.next().to(self.device)
        # One simulator has no dimension of its own, and several workers have one more.
        batch = batch.reshape(-1, batch.shape[-1]).copy()
        batch["next", "reward"] = self.reward_scale * batch["next", "reward"]
        self.learner.observe(batch)
        rows = batch.reshape(-1) if self.multi_step is None else self.multi_step(batch)
        if len(rows):
            self.buffer.extend(rows.select(*self._kept))
        self.progress.frames += self.action_repeat * batch.numel()
        self.progress.episodes += int(batch["next", "done"].sum())
        if self.frames > self.learning_starts and len(self.buffer):
            self.earn(batch.numel())
        return batch.reshape(-1)

    def learn(self) -> Work[TensorDictBase | None]:
        """The updates that the collected frames have earned; returns their mean scalars.

        The thousands that a prefilled buffer has earned are made up for in parts, see
        :attr:`behind`.
        """
        due = min(int(self.progress.owed), self._most_updates)
        self.progress.owed -= due
        self.progress.updates += due
        logs = []
        for few in self.updates(due, self.updated, self.name):
            logs.append((yield few))
        self.learner.advance(self.frames, self.frames / self.budget)
        return torch.cat(logs).mean(0) if logs else None

    def updates(self, count: int, learner: SACLearner, name: str) -> Iterator[Due]:
        """So many updates of a learner on sampled batches, a few at once, under this name."""
        for few in parts(count, AT_ONCE[self.device.type]):
            yield Due(name, learner, learner.inputs(self.samples(few)))

    def samples(self, count: int) -> TensorDictBase:
        """Batches [count, B] out of the buffer."""
        rows = self.buffer.sample(count * self.batch_size).to(self.device)
        return rows.reshape(count, self.batch_size)

    def sample(self) -> TensorDictBase:
        """A batch [B] out of the buffer."""
        return self.samples(1)[0]

    def update(self) -> TensorDictBase:
        """One update on a sampled batch; returns scalars to log."""
        return self.updated.update(self.sample())

    def earn(self, transitions: int) -> None:
        """Owe the updates that the frames of so many transitions are worth."""
        self.progress.owed += self.action_repeat * transitions * self.replay_ratio

    @property
    def behind(self) -> bool:
        """Whether :meth:`learn` left updates for later."""
        return self.progress.owed >= 1

    def prefill(self, rows: TensorDictBase) -> None:
        """Put transitions of another policy into the buffer; they earn updates like one's own.

        Their reward is the task's, unscaled.
        """
        rows = rows.copy()
        rows["next", "reward"] = self.reward_scale * rows["next", "reward"]
        if self.multi_step is not None:
            rows["steps_to_next_obs"] = torch.ones(rows.shape, dtype=torch.long, device=rows.device)
        if self.learner.objective.normalizer is not None:
            self.learner.objective.normalizer.see(rows["observation"])
        self.buffer.extend(rows.select(*self._kept))
        self.earn(len(rows))

    def newest(self, count: int) -> TensorDictBase:
        """Up to ``count`` of the latest transitions, oldest first."""
        rows, writer = self.buffer.storage[:], self.buffer.writer
        if len(rows) == self.buffer.storage.max_size:  # full: the oldest row is the next to go
            rows = torch.cat([rows[writer._cursor :], rows[: writer._cursor]])
        return rows[-count:]

    def start_collection(self) -> None:
        """Let workers start, if there are none; :meth:`restart_collection` waits for them."""
        if self.batches is None:
            self._restart_policy()  # which workers copy as they start
            # Only a run that begins or resumes builds a collector: that must not show.
            random = GlobalRNGState().state_dict()
            self.batches = self._make_batches(seed=self._collection_seed)
            GlobalRNGState().load_state_dict(random)

    def restart_collection(self) -> None:
        """Begin new episodes, seeded by the frame count.

        A checkpoint cannot hold the inside of a simulator. Starting fresh episodes at every
        checkpoint, in a run that goes on just as in one that was resumed, makes the two equal.
        """
        self.start_collection()
        try:
            self.batches.await_start()
        except CollectionError:
            self._close_batches()  # so that the next call starts others
            raise
        self._restart_policy()
        if self.multi_step is not None:
            self.multi_step.forget()
        self.batches.restart(self._collection_seed)

    def _restart_policy(self) -> None:
        self.learner.restart(self.frames // self._frames_per_action)

    @property
    def _collection_seed(self) -> int:
        return training_seed(self.seed, self.frames + 15_485_863 * self.restart_seed)

    def collect_from(self, **collector: Any) -> None:
        """Collect by other arguments of :func:`~torchrl_etl.collectors.make_batches`, from the next
        :meth:`restart_collection` on.
        """
        self._close_batches()
        self._make_batches = partial(self._make_batches, **collector)

    def checkpoint(self) -> Checkpoint:
        """Everything the stage needs to go on, as a TorchRL checkpoint."""
        parts = {**self.learner.parts, "progress": self.progress, "rng": GlobalRNGState()}
        parts["transforms"] = self.transforms
        return Checkpoint(**parts).register("buffer", self.buffer, adapter=BufferAdapter())

    def close(self) -> None:
        self._close_batches()
        if isinstance(self.buffer.storage, LazyMemmapStorage):
            shutil.rmtree(self.buffer.storage.scratch_dir, ignore_errors=True)

    def _close_batches(self) -> None:
        if self.batches is not None:
            self.batches.close()
            # Simulators hold 100 MB each and sit in reference cycles: do not wait for the
            # garbage collector to come by.
            self.batches = None
            gc.collect()


def check_budget(frames: int, replay_ratio: float) -> None:
    """Refuse numbers of frames, and of updates per frame, that no stage can have.

    Examples:
        >>> check_budget(1000, 1e9)
        Traceback (most recent call last):
        ...
        ValueError: replay_ratio is 1000000000.0; it must be a number in (0, 1000].
    """
    check_integer(1, frames=frames)
    check_real("(0, 1000]", replay_ratio=replay_ratio)


def parts(total: int, most: int) -> list[int]:
    """A number as a sum of numbers that are no larger than ``most``.

    Examples:
        >>> parts(40, 16)
        [16, 16, 8]
    """
    return [min(most, total - done) for done in range(0, total, most)]


def frames_per_action(collector: Mapping[str, Any], action_repeat: int) -> int:
    """Frames of a run for each action of one of its workers.

    Examples:
        >>> frames_per_action({"kind": "process", "num_workers": 4}, action_repeat=2)
        8
    """
    return action_repeat * (1 if collector["kind"] == "single" else collector["num_workers"])
