"""The storage of a replay buffer, and its checkpoints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointAdapter
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer, Storage

from torchrl_etl.io import reserve

__all__ = ["BufferAdapter", "make_storage"]


def make_storage(size: int, device: torch.device, scratch: Path | None) -> Storage:
    """Storage for ``size`` transitions, allocated on first use; in files if ``scratch`` is set."""
    if scratch is None:
        return LazyTensorStorage(size, device=device)
    # Without a folder, TorchRL 0.14.1 maps shared memory, which still occupies RAM.
    return ReservedMemmapStorage(size, scratch_dir=scratch, existsok=True)


class ReservedMemmapStorage(LazyMemmapStorage):
    """Reserves disk space at once: TorchRL maps sparse files, so a full disk would kill the run."""

    def _init(self, data: Any) -> None:
        try:
            super()._init(data)
        except RuntimeError as error:  # raised by PyTorch if a file cannot be this large
            raise OSError(
                f"There is no room for a buffer in {self.scratch_dir}: {error}"
            ) from error
        for file in Path(self.scratch_dir).rglob("*.memmap"):
            reserve(file)


class BufferAdapter(CheckpointAdapter):
    """Saves the filled part of a buffer as memory maps.

    TorchRL's own adapter (0.14.1) writes the storage at full capacity, cannot load it into another
    capacity (so a resume could not change the budget), and pickles the prefetch queue.
    """

    adapter_id = "torchrl_etl.buffer"

    def save(self, component: ReplayBuffer, path: Path, **_: Any) -> None:
        path.mkdir(parents=True)
        rows = component.storage[:] if len(component) else TensorDict({}, [0])
        rows.cpu().memmap(str(path / "rows"), copy_existing=True)
        position = {"cursor": component.writer._cursor, "rows": len(component)}
        (path / "position.json").write_text(json.dumps(position))

    def load(self, component: ReplayBuffer, path: Path, **_: Any) -> None:
        position = json.loads((path / "position.json").read_text())
        component.empty()
        if position["rows"]:
            rows, cursor = TensorDict.load_memmap(path / "rows"), position["cursor"]
            if position["rows"] == component.storage.max_size:  # full: the oldest row goes next
                component.extend(rows)
                component.writer._cursor = cursor % position["rows"]
            else:  # other capacity: oldest rows first, only the newest if not all fit
                rows = torch.cat([rows[cursor:], rows[:cursor]])
                component.extend(rows[-component.storage.max_size :])
