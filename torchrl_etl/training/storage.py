"""Storage of a replay buffer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, Storage

from torchrl_etl.io import reserve

__all__ = ["make_storage"]


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
