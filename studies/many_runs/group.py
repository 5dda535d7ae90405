"""Runs whose networks have one shape, between their simulators and the device they learn on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from torchrl_etl.synergies import load_bundle

from .learner import Learner
from .returns import ReturnScales
from .settings import Settings, Shape
from .simulators import Simulators

__all__ = ["Group"]

# Columns of the learner's buffer, and what they are called in what stage 1 left.
EXPLORED = {
    "observation": "observation",
    "following": "next.observation",
    "emitted": "synergy",
    "action": "action",
    "reward": "next.reward",
    "terminated": "next.terminated",
    "done": "next.done",
}


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
        if "synergies" in self.runs[0] and not described.get("raw"):
            residual = described.get("residual", 1.0)
            decoders = [load_bundle(run["synergies"], residual=residual)[0] for run in self.runs]
        # The seed of stage 2, see torchrl_etl.training.experiment.
        seeds = [2 * run["seed"] + 1 for run in self.runs]
        given, count = None, 0
        if described.get("reuse"):
            given = explored(self.runs, max(observations), raw=decoders is None)
            count = given["reward"].shape[1]
        self.owed = count * self.shape.updates  # made up for as soon as learning starts
        self.learner = Learner(
            self.shape, settings, seeds, observations, actions, decoders, frames + count, device
        )
        if given is not None:
            self.learner.give(given)
        torch.manual_seed(seeds[0])
        self.scales = ReturnScales(np.array([s.gamma for s in settings]), self.shape.bound)
        self.told = torch.zeros(self.learner.told.shape)
        self.told[:, 2:4] = 1.0  # an episode begins; no scale is known
        self.moved = torch.zeros(self.learner.muscles.shape)
        self.stream: torch.cuda.Stream | None = None
        if device.type == "cuda":
            self.told, self.moved = self.told.pin_memory(), self.moved.pin_memory()
            self.stream = torch.cuda.Stream()
            self.event = torch.cuda.Event()
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
            for _ in range(self.shape.updates + self.owed):
                self.learner.update()
        self.owed = 0

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


def explored(runs: Sequence[Mapping[str, Any]], width: int, raw: bool) -> dict[str, Tensor]:
    """What stage 1 left beside the synergies of each run, as rows of the learner's buffer.

    As in :meth:`torchrl_etl.training.learn.LearnStage.take`.
    """
    padded: dict[str, list[Tensor]] = {}
    for run in runs:
        rows = load_file(Path(run["synergies"]).parent / "explored.safetensors")
        for name, key in EXPLORED.items():
            value = rows[key].float()
            if name in ("observation", "following"):
                value = nn.functional.pad(value, (0, width - value.shape[-1]))
            if name == "emitted" and raw:
                value = rows["action"]
            elif name == "emitted":  # no residual
                value = nn.functional.pad(value, (0, rows["action"].shape[-1]))
            padded.setdefault(name, []).append(value)
    return {name: torch.stack(values) for name, values in padded.items()}
