"""A stage of a run: a collector fills a replay buffer, from which a learner samples batches."""

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
from torchrl_etl.training.buffer import BufferAdapter, make_storage
from torchrl_etl.training.continued_multi_step import ContinuedMultiStep
from torchrl_etl.training.work import PendingUpdates, Work

__all__ = ["Progress", "Stage"]

TRANSITION = (
    "observation",
    "action",
    *(("next", key) for key in ("observation", "reward", "done", "terminated")),
)


AT_ONCE = {"cpu": 16, "cuda": 64}
"""Batches to sample at once: more overflow the caches of a CPU, fewer leave a GPU idle."""


class Progress:
    """Counters of a stage, saved in its checkpoints.

    ``owed`` is the number of updates that are due for the frames so far and have not been run;
    ``seconds`` is the wall time of the stage, summed over resumes.
    """

    def __init__(self) -> None:
        self.frames, self.updates, self.owed, self.episodes = 0, 0, 0.0, 0
        self.seconds = 0.0

    def state_dict(self) -> dict[str, float]:
        return dict(vars(self))

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        vars(self).update(state)


class Stage:
    """Collects frames with a learner's behavior policy and updates it at a fixed replay ratio.

    Args:
        name (str): name in logs and checkpoints.
        learner (SACLearner): the learner; its ``behavior`` collects.
        make_env (callable): builds the environment to collect from, transforms included.

    Keyword Args:
        updated (SACLearner or None): the learner to update: ``learner``, one that shares its
            networks (:meth:`~torchrl_etl.learners.SACLearner.only`), or none.
        frames (int): budget of the stage, in environment frames.
        seed (int): seed of the stage.
        device (torch.device): device of the buffer and of sampled batches.
        scratch (path): folder for the files of a ``"memmap"`` buffer, deleted by :meth:`close`.
        collector (mapping): arguments of :func:`~torchrl_etl.collectors.make_batches`.
        buffer_size (int): capacity in transitions, 2 or more; the budget caps what is allocated.
        buffer_storage (str): "memory" keeps transitions on the device, "memmap" in files.
        batch_size (int): transitions per update, 2 or more.
        replay_ratio (float): updates per frame, above 0 and up to 1,000.
        learning_starts (int): frames before the first update.
        reward_scale (float): factor on the task's reward for learning; logged returns are unscaled.
        n_steps (int): rewards in a critic's target before it bootstraps, fewer at the end of an
            episode. Intermediate steps get no entropy bonus. Default: 1.
        gamma (float): discount factor of these rewards.
        keep (sequence of NestedKey): additional entries of a transition to store.
        transforms (sequence of Transform): applied to rows sampled for many updates at once;
            transforms that depend on current weights belong to the learner instead.
        prefill_size (int): transitions to allocate for a prefill, on top of the budget. Default: 0.
        action_repeat (int): frames per transition. Default: 1.
        restart_seed (int): change it to collect other episodes with the same ``seed``, for example
            to resume a run whose simulation diverged. Default: 0.

    Raises:
        ValueError: if an argument is invalid; the message names it.
    """

    def __init__(
        self,
        name: str,
        learner: SACLearner,
        make_env: Callable[[], EnvBase],
        *,
        updated: SACLearner | None,
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
        gamma: float,
        n_steps: int = 1,
        keep: Sequence[NestedKey] = (),
        transforms: Sequence[Transform] = (),
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
        self.name, self.learner, self.updated = name, learner, updated
        self.seed, self.device = seed, device
        self.budget, self.action_repeat, self.reward_scale = frames, action_repeat, reward_scale
        self.batch_size, self.replay_ratio = batch_size, replay_ratio
        self.learning_starts, self.restart_seed = learning_starts, restart_seed
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
            self.multi_step = ContinuedMultiStep(gamma, n_steps)
            self._kept.append("steps_to_next_obs")

    @property
    def frames(self) -> int:
        return self.progress.frames

    @property
    def finished(self) -> bool:
        return self.frames >= self.budget

    def request(self) -> None:
        """Let workers start on the next batch with the current policy."""
        self.batches.request()

    def collect(self) -> TensorDictBase:
        """Collect one batch into the buffer; returns the batch, flattened."""
        batch = self.batches.next().to(self.device)
        # A single simulator adds no batch dimension; several workers add one more.
        batch = batch.reshape(-1, batch.shape[-1]).copy()
        batch["next", "reward"] = self.reward_scale * batch["next", "reward"]
        self.learner.observe(batch)
        rows = batch.reshape(-1) if self.multi_step is None else self.multi_step(batch)
        if len(rows):
            self.buffer.extend(rows.select(*self._kept))
        self.progress.frames += self.action_repeat * batch.numel()
        self.progress.episodes += int(batch["next", "done"].sum())
        learns = self.updated is not None and self.frames > self.learning_starts
        if learns and len(self.buffer):
            self.add_due_updates(batch.numel())
        return batch.reshape(-1)

    def learn(self) -> Work[TensorDictBase | None]:
        """Run the updates that are due; returns the mean of their scalars.

        A call runs at most twice the updates of one batch, so that the many updates due after a
        prefill are spread over several calls; see :attr:`has_due_updates`.
        """
        due = min(int(self.progress.owed), self._most_updates)
        self.progress.owed -= due
        self.progress.updates += due
        logs = []
        for few in self.updates(due, self.updated, self.name):
            logs.append((yield few))
        self.learner.advance(self.frames, self.frames / self.budget)
        return torch.cat(logs).mean(0) if logs else None

    def updates(self, count: int, learner: SACLearner, name: str) -> Iterator[PendingUpdates]:
        """Yield ``count`` updates on sampled batches, a few at a time, for the stage ``name``."""
        most = AT_ONCE[self.device.type]
        for done in range(0, count, most):
            few = self.samples(min(most, count - done))
            yield PendingUpdates(name, learner, learner.inputs(few))

    def samples(self, count: int) -> TensorDictBase:
        """Sample batches [count, B] from the buffer."""
        rows = self.buffer.sample(count * self.batch_size).to(self.device)
        return rows.reshape(count, self.batch_size)

    def add_due_updates(self, transitions: int) -> None:
        """Add the updates due for this many transitions."""
        self.progress.owed += self.action_repeat * transitions * self.replay_ratio

    @property
    def has_due_updates(self) -> bool:
        """Whether :meth:`learn` still has updates to run."""
        return self.progress.owed >= 1

    def prefill(self, rows: TensorDictBase) -> None:
        """Add transitions of another policy to the buffer; they count toward the replay ratio.

        Their reward must be the task's, unscaled.
        """
        rows = rows.copy()
        rows["next", "reward"] = self.reward_scale * rows["next", "reward"]
        if self.multi_step is not None:
            rows["steps_to_next_obs"] = torch.ones(rows.shape, dtype=torch.long, device=rows.device)
        if self.learner.objective.normalizer is not None:
            self.learner.objective.normalizer.update_moments(rows["observation"])
        self.buffer.extend(rows.select(*self._kept))
        self.add_due_updates(len(rows))

    def newest(self, count: int) -> TensorDictBase:
        """Up to ``count`` of the latest transitions, oldest first."""
        rows, writer = self.buffer.storage[:], self.buffer.writer
        if len(rows) == self.buffer.storage.max_size:  # full: the oldest row is overwritten next
            rows = torch.cat([rows[writer._cursor :], rows[: writer._cursor]])
        return rows[-count:]

    def start_collection(self) -> None:
        """Start workers if there are none; :meth:`restart_collection` waits for them."""
        if self.batches is None:
            self._restart_policy()  # workers copy the policy as they start
            # An uninterrupted run builds no collector here, so a build must not advance the RNG.
            random = GlobalRNGState().state_dict()
            self.batches = self._make_batches(seed=self._collection_seed)
            GlobalRNGState().load_state_dict(random)

    def restart_collection(self) -> None:
        """Begin new episodes, seeded by the frame count.

        A checkpoint cannot store the state of a simulator. Every run therefore starts new episodes
        at each checkpoint, so that a resumed run and an uninterrupted one give the same numbers.
        """
        self.start_collection()
        try:
            self.batches.await_start()
        except CollectionError:
            self._close_batches()  # so that the next call starts new workers
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
        """Change arguments of :func:`~torchrl_etl.collectors.make_batches`, effective from the next
        :meth:`restart_collection`.
        """
        self._close_batches()
        self._make_batches = partial(self._make_batches, **collector)

    def checkpoint(self) -> Checkpoint:
        """Everything that a resume needs, as a TorchRL checkpoint."""
        own = {"progress": self.progress, "rng": GlobalRNGState(), "transforms": self.transforms}
        whole = Checkpoint(**self.learner.components, **own)
        return whole.register("buffer", self.buffer, adapter=BufferAdapter())

    def close(self) -> None:
        self._close_batches()
        if isinstance(self.buffer.storage, LazyMemmapStorage):
            shutil.rmtree(self.buffer.storage.scratch_dir, ignore_errors=True)

    def _close_batches(self) -> None:
        if self.batches is not None:
            self.batches.close()
            # Simulators take 100 MB each and sit in reference cycles, so collect garbage now.
            self.batches = None
            gc.collect()


def check_budget(frames: int, replay_ratio: float) -> None:
    """Raise a ``ValueError`` for an invalid frame budget or replay ratio.

    Examples:
        >>> check_budget(1000, 1e9)
        Traceback (most recent call last):
        ...
        ValueError: replay_ratio is 1000000000.0; it must be a number in (0, 1000].
    """
    check_integer(1, frames=frames)
    check_real("(0, 1000]", replay_ratio=replay_ratio)


def frames_per_action(collector: Mapping[str, Any], action_repeat: int) -> int:
    """Frames of a run per action of each worker.

    Examples:
        >>> frames_per_action({"kind": "process", "num_workers": 4}, action_repeat=2)
        8
    """
    return action_repeat * (1 if collector["kind"] == "single" else collector["num_workers"])
