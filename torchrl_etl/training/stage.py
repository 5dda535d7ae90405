"""What both stages share: a collector, a buffer, and an update that is owed per frame."""

from __future__ import annotations

import gc
import math
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.optim import Adam, Optimizer
from torchrl.checkpoint import Checkpoint, GlobalRNGState
from torchrl.data import (
    Bounded,
    LazyMemmapStorage,
    LazyTensorStorage,
    Storage,
    TensorDictReplayBuffer,
)
from torchrl.envs import EnvBase
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_etl.collectors import Batches, make_batches
from torchrl_etl.collectors.seeds import training_seed
from torchrl_etl.objectives import FusedSoftUpdate
from torchrl_etl.training.buffer_adapter import BufferAdapter
from torchrl_etl.training.compiled import compiled, cuda_graph

__all__ = [
    "Progress",
    "Stage",
    "entropy_target",
    "gradient_step",
    "make_optimizer",
    "ready_for_training",
]


class Progress:
    """Counters of a stage, saved with it.

    ``owed`` is the fraction of an update that the frames so far have earned but not yet had;
    ``seconds`` is the wall time that the stage took, over all its starts.
    """

    def __init__(self) -> None:
        self.frames, self.updates, self.owed, self.episodes = 0, 0, 0.0, 0
        self.seconds = 0.0

    def state_dict(self) -> dict[str, float]:
        return dict(vars(self))

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        vars(self).update(state)


class Stage(ABC):
    """One stage of ETL: collect a batch, keep it, update as often as its frames have earned.

    Args:
        make_env (callable): environment to collect from, transforms included.
        policy (TensorDictModuleBase): acts in it; its weights are shared with the losses.

    Keyword Args:
        frames (int): budget of the stage, in environment frames.
        seed (int): seed of the stage.
        device (torch.device): where networks and buffer live.
        buffer_size (int): transitions to keep; never more than the budget are allocated.
        buffer_storage (str): "memory" keeps them on the device, "memmap" in files.
        scratch (path): folder for these files, which are deleted when the stage is closed.
        batch_size (int): transitions in an update.
        collector (mapping): arguments of :func:`~torchrl_etl.collectors.make_batches`.
        action_repeat (int): frames that a transition of the collector takes. Default: 1.
        updates_per_frame (float): updates per collected frame.
        learning_starts (int): frames before the first update.
        reward_scale (float): factor on the task's reward as the buffer keeps it.
        given (int): transitions to make room for beside the budget. Default: 0.
        restart_seed (int): another one collects other episodes with the same ``seed``, so that a
            run whose simulation diverges can go on from its checkpoint. Default: 0.
        compile (bool): compile updates; on CUDA they also become one CUDA graph.
            Default: ``False``.
    """

    name: str
    optimizer: Adam
    targets: Sequence[SoftUpdate]

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        policy: TensorDictModuleBase,
        *,
        collector: Mapping[str, Any],
        frames: int,
        seed: int,
        device: torch.device,
        buffer_size: int,
        buffer_storage: Literal["memory", "memmap"],
        scratch: Path,
        batch_size: int,
        updates_per_frame: float,
        learning_starts: int,
        reward_scale: float,
        action_repeat: int = 1,
        given: int = 0,
        restart_seed: int = 0,
        compile: bool = False,
    ) -> None:
        self.policy, self.seed, self.device = policy, seed, device
        self.restart_seed = restart_seed
        self.reward_scale = reward_scale
        self.budget = frames
        self.action_repeat = action_repeat
        self._make_batches = partial(
            make_batches, **collector, make_env=make_env, policy=policy, device=device
        )
        self.updates_per_frame, self.learning_starts = updates_per_frame, learning_starts
        self.progress = Progress()
        self.buffer = TensorDictReplayBuffer(
            storage=make_storage(
                min(buffer_size, given + frames // action_repeat + collector["frames_per_batch"]),
                device,
                scratch / self.name if buffer_storage == "memmap" else None,
            ),
            batch_size=batch_size,
        )
        batch_frames = action_repeat * collector["frames_per_batch"]
        self._most_updates = math.ceil(2 * updates_per_frame * batch_frames)
        self.batches: Batches | None = None
        self._gradients = compiled(self.gradients) if compile else self.gradients
        graphed = compile and device.type == "cuda"
        self._step = cuda_graph(self.step) if graphed else self.step

    # What a stage defines -------------------------------------------------------------------

    @abstractmethod
    def transitions(self, batch: TensorDictBase) -> TensorDictBase:
        """The entries of a flat batch that the buffer keeps."""

    @abstractmethod
    def losses(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """What an update on this batch minimizes, all parts summed, and the scalars to log."""

    @abstractmethod
    def parts(self) -> dict[str, Any]:
        """Stateful parts by name (losses, optimizers, statistics) for the checkpoint."""

    def seen(self, batch: TensorDictBase) -> TensorDictBase:
        """A batch [simulators, time] as it came, once a stage has taken note of what it wants."""
        return batch

    def spanned(self, batch: TensorDictBase) -> TensorDictBase:
        """Transitions [*] of a batch [simulators, time], over as many steps as a target spans."""
        return batch.reshape(-1)

    # What every stage does -------------------------------------------------------------------

    @property
    def frames(self) -> int:
        return self.progress.frames

    @property
    def finished(self) -> bool:
        return self.frames >= self.budget

    def restart_collection(self) -> None:
        """Begin new episodes, seeded by the frame count.

        A checkpoint cannot hold the inside of a simulator. Starting fresh episodes at every
        checkpoint, in a run that goes on just as in one that was resumed, makes the two equal.
        """
        seed = training_seed(self.seed, self.frames + 15_485_863 * self.restart_seed)
        if self.batches is None:
            # Only a run that begins or resumes builds a collector: that must not show.
            random = GlobalRNGState().state_dict()
            self.batches = self._make_batches(seed=seed)
            GlobalRNGState().load_state_dict(random)
        self.batches.restart(seed)

    def collect(self) -> TensorDictBase:
        """Collect one batch into the buffer; returns the whole batch, flat."""
        batch = self.batches.next().to(self.device)
        # One simulator has no dimension of its own, and several workers have one more.
        batch = self.seen(batch.reshape(-1, batch.shape[-1]))
        if len(rows := self.spanned(batch)):
            self.buffer.extend(self.transitions(rows))
        batch = batch.reshape(-1)
        self.progress.frames += self.action_repeat * batch.numel()
        self.progress.episodes += int(batch["next", "done"].sum())
        if self.frames > self.learning_starts and len(self.buffer):
            self.earn(batch.numel())
        return batch

    def earn(self, transitions: int) -> None:
        """Owe the updates that the frames of so many transitions are worth."""
        self.progress.owed += self.action_repeat * transitions * self.updates_per_frame

    def learn(self) -> TensorDictBase | None:
        """The updates that the collected frames have earned; returns their mean scalars.

        The thousands for frames that were given are made up for in parts, see :attr:`behind`.
        """
        due = min(int(self.progress.owed), self._most_updates)
        self.progress.owed -= due
        self.progress.updates += due
        logs = [self.update() for _ in range(due)]
        return torch.stack(logs).mean(0) if logs else None

    @property
    def behind(self) -> bool:
        """Whether :meth:`learn` left updates for later."""
        return self.progress.owed >= 1

    def update(self) -> TensorDictBase:
        """One gradient step on every part that this stage trains; returns scalars to log."""
        return self._step(self.buffer.sample().to(self.device))

    def step(self, batch: TensorDictBase) -> TensorDictBase:
        """An update on this batch."""
        gradients, scalars = self._gradients(batch)
        for parameter, gradient in zip(self._trained(), gradients, strict=True):
            parameter.grad = gradient
        self.optimizer.step()
        self.constrain()
        for target in self.targets:
            target.step()
        return scalars

    def gradients(self, batch: TensorDictBase) -> tuple[tuple[Tensor | None, ...], TensorDictBase]:
        """Gradients of what is trained, and the scalars to log."""
        loss, scalars = self.losses(batch)
        return torch.autograd.grad(loss, self._trained(), allow_unused=True), scalars.detach()

    def constrain(self) -> None:  # noqa: B027 (most stages have nothing to do here)
        """Bring parameters back to where they must lie, after every step of the optimizer."""

    def _trained(self) -> list[Tensor]:
        return [parameter for group in self.optimizer.param_groups for parameter in group["params"]]

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
        if self.batches is not None:
            self.batches.close()
            # Simulators hold 100 MB each and sit in reference cycles: do not wait for the
            # garbage collector to come by.
            self.batches = None
            gc.collect()
        if isinstance(self.buffer.storage, LazyMemmapStorage):
            shutil.rmtree(self.buffer.storage.scratch_dir, ignore_errors=True)


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


def make_storage(size: int, device: torch.device, scratch: Path | None) -> Storage:
    """Room for ``size`` transitions, taken when the first one comes; in files with ``scratch``."""
    if scratch is None:
        return LazyTensorStorage(size, device=device)
    # Without a folder TorchRL 0.14.1 maps shared memory, which is memory all the same.
    return LazyMemmapStorage(size, scratch_dir=scratch, existsok=True)


def ready_for_training(sac: SACLoss, *, gamma: float, tau: float) -> SoftUpdate:
    """Give a SAC loss its discount factor and its target updater."""
    sac.make_value_estimator(gamma=gamma)
    _ = sac.target_entropy  # created lazily; it must exist before the optimizer does
    return FusedSoftUpdate(sac, tau=tau)


def make_optimizer(device: torch.device, *groups: tuple[Iterable[Tensor], float]) -> Adam:
    """Adam for several groups of parameters, each with its learning rate.

    All groups take their step in one operation, which a CUDA graph can hold; it reads learning
    rates from tensors there, so that they can change.
    """
    graphed = device.type == "cuda"
    return Adam(
        [
            {"params": list(of), "lr": torch.tensor(lr, device=device) if graphed else lr}
            for of, lr in groups
        ],
        fused=True,
        capturable=graphed,
    )


def gradient_step(optimizer: Optimizer, loss: Tensor) -> None:
    """One optimizer step on what this loss reaches."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()
