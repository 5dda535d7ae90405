"""Where the transitions of a replay buffer are kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, Storage

from torchrl_etl.io import reserve

__all__ = ["make_storage"]


def make_storage(size: int, device: torch.device, scratch: Path | None) -> Storage:
    """Room for ``size`` transitions, taken when the first one comes; in files with ``scratch``."""
    if scratch is None:
        return LazyTensorStorage(size, device=device)
    # Without a folder TorchRL 0.14.1 maps shared memory, which is memory all the same.
    return ReservedMemmapStorage(size, scratch_dir=scratch, existsok=True)


class ReservedMemmapStorage(LazyMemmapStorage):
    """TorchRL's storage maps sparse files: a full disk would kill the run later, without a word."""

    def _init(self, data: Any) -> None:
        try:
            super()._init(data)
        except RuntimeError as error:  # how PyTorch says that a file cannot be so large
            raise OSError(f"A buffer has no room in {self.scratch_dir}: {error}") from error
        for file in Path(self.scratch_dir).rglob("*.memmap"):
            reserve(file)
