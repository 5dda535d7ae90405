"""Runs whose networks have one shape, between their simulators and the device they learn on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch

from torchrl_etl.modules.bundle import load_bundle

from .learner import Learner
from .returns import ReturnScales
from .settings import Settings, Shape
from .simulators import Simulators

__all__ = ["Group"]


class Group:
    """Learns the runs in ``rows`` of the simulators' arrays.

    On CUDA nothing here waits for the device but :meth:`actions`: each group has a stream of its
    own, on which groups of one process go on side by side. (Processes that share a GPU take
    turns, and each waits for all.)

    Args:
        described (mapping): ``shape`` and ``runs``, see ``__main__``.
        rows (slice): of the arrays.
        observations (sequence of int): entries that each run's task shows.
        actions (int): muscles.
        frames (int): of each run.
        device (torch.device): where networks and buffers live.
    """

    def __init__(
        self,
        described: Mapping[str, Any],
        rows: slice,
        observations: Sequence[int],
        actions: int,
        frames: int,
        device: torch.device,
    ) -> None:
        self.runs, self.rows = described["runs"], rows
        self.shape = Shape(**described.get("shape", {}))
        settings = [Settings(**run.get("settings", {})) for run in self.runs]
        decoders = None
        if "synergies" in self.runs[0]:
            residual = described.get("residual", 1.0)
            decoders = [load_bundle(run["synergies"], residual=residual)[0] for run in self.runs]
        # The seed of stage 2, see torchrl_etl.training.experiment.
        seeds = [2 * run["seed"] + 1 for run in self.runs]
        self.learner = Learner(
            self.shape, settings, seeds, observations, actions, decoders, frames, device
        )
        torch.manual_seed(seeds[0])
        self.scales = ReturnScales(np.array([s.gamma for s in settings]), self.shape.bound)
        self.told = torch.zeros(self.learner.told.shape)
        self.told[:, 2:4] = 1.0  # an episode begins; no scale is known
        self.moved = torch.zeros(self.learner.muscles.shape)
        self.stream: torch.cuda.Stream | None = None
        if device.type == "cuda":
            self.told, self.moved = self.told.pin_memory(), self.moved.pin_memory()
            self.stream = torch.cuda.Stream()
            self.event = torch.cuda.Event(blocking=True)  # the wait is asleep: others need cores
            torch.cuda.synchronize()

    def _on_stream(self) -> AbstractContextManager:
        return nullcontext() if self.stream is None else torch.cuda.stream(self.stream)

    def act(self, *, trained: bool = False) -> None:
        """Let the actor choose, or its average without noise."""
        with self._on_stream():
            (self.learner.try_out if trained else self.learner.act)()
            self.moved.copy_(self.learner.muscles, non_blocking=True)
            if self.stream is not None:
                self.event.record()

    def actions(self) -> np.ndarray:
        """What was chosen [N, n]."""
        if self.stream is not None:
            self.event.synchronize()
        return self.moved.numpy()

    def update(self) -> None:
        with self._on_stream():
            for _ in range(self.shape.updates):
                self.learner.update()

    def store(self, simulators: Simulators) -> None:
        """Keep the step that was taken with the last actions."""
        reward, done = simulators.reward[self.rows], simulators.done[self.rows]
        self.scales.step(reward, done)
        told, width = self.told.numpy(), self.learner.width
        told[:, 0], told[:, 1] = reward, simulators.terminated[self.rows]
        told[:, 2], told[:, 3] = done, self.scales.scale
        told[:, 4 : 4 + width] = simulators.following[self.rows, :width]
        with self._on_stream():
            self._show(simulators)
            self.learner.store()

    def show(self, simulators: Simulators) -> None:
        """Tell what is seen now; what was told else stays."""
        with self._on_stream():
            self._show(simulators)

    def _show(self, simulators: Simulators) -> None:
        width = self.learner.width
        self.told.numpy()[:, -width:] = simulators.observation[self.rows, :width]
        self.learner.told.copy_(self.told, non_blocking=True)
