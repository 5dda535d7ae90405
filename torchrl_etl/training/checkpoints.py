"""Checkpoints that survive a crash at any time, with detection of damaged ones."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation
from torchrl.data import ReplayBuffer

from torchrl_etl.io import check_disk_space, flush_folder, write_atomically

__all__ = ["Checkpoints"]

_SEAL = "seal.json"
_SMALL_FILES = 1_000_000  # bytes, an upper bound for the JSON besides the tensors
# Suffixes that TorchRL writes for tensors and plain values. Other files, pickles above all, could
# run code when loaded, so they are refused before TorchRL reads them.
_PLAIN_FILES = {".json", ".memmap"}


class Checkpoints(CheckpointRotation):
    """TorchRL's checkpoint rotation, with digests that show whether a checkpoint is complete.

    ``torchrl.checkpoint`` (0.14.1) publishes a folder by an atomic rename, but neither flushes
    its files to disk nor detects damage. Here every file is flushed, and its SHA-256 is written to
    ``seal.json``, before the folder is renamed. A folder with the name of a checkpoint was thus
    complete once. If its seal is missing or does not match, the previous checkpoint is used. At
    least two are kept, so that one is always complete.
    """

    def save(self, checkpoint: Checkpoint, *, step: int, **kwargs: Any) -> Path:
        """Save, flush and seal a checkpoint of frame ``step``; returns its folder."""
        self._remove_leftovers()
        # TorchRL memory-maps sparse files; on a full disk, writing to one kills the process.
        check_disk_space(self.directory, _size(checkpoint.components) + _SMALL_FILES)
        folder = self._checkpoint_path(step, "directory")
        fresh = folder.with_name(f".{folder.name}.stage-unsealed")
        try:
            checkpoint.save(fresh, **kwargs)
        except RuntimeError as error:  # raised by PyTorch if the disk is full
            raise OSError(f"A checkpoint cannot be written to {self.directory}: {error}") from error
        write_atomically(fresh / _SEAL, json.dumps(_digests(fresh, flush=True), indent=1))
        if folder.exists():  # a damaged one that a resume has skipped
            self._remove_atomically(folder)
        os.replace(fresh, folder)
        flush_folder(self.directory)
        self.prune()
        return folder

    def checkpoints(self) -> tuple[Path, ...]:
        """All checkpoints by frame; TorchRL's version skips those with a damaged manifest."""
        named = self.directory.glob(f"{self.prefix}-*")
        return tuple(sorted(path for path in named if path.name.rpartition("-")[2].isdigit()))

    def newest_whole(self) -> Path | None:
        """The newest undamaged checkpoint; warns about newer damaged ones."""
        for folder in reversed(self.checkpoints()):
            fault = _fault(folder)
            if fault is None:
                return folder
            warnings.warn(
                f"Checkpoint {folder} is damaged ({fault}); using the one before.",
                stacklevel=2,
            )
        return None

    def load_newest_whole(self, checkpoint: Checkpoint) -> bool:
        """Restore the newest undamaged checkpoint; returns False if there are no checkpoints.

        Raises:
            OSError: if all checkpoints are damaged (a fresh start would delete what is left of
                them), or if the checkpoint was made with another configuration.
        """
        folder = self.newest_whole()
        if folder is not None:
            try:
                checkpoint.load(folder)
            except CheckpointError as error:
                raise OSError(
                    f"Checkpoint {folder} does not fit the run's current settings ({error}); "
                    "resume without the settings that were changed."
                ) from error
        elif self.checkpoints():
            raise OSError(
                f"All checkpoints in {self.directory} are damaged; copy them from a backup of the "
                "run, or start a new run."
            )
        return folder is not None

    def _remove_leftovers(self) -> None:
        """Delete partially written folders of a process that was killed while saving."""
        for pattern in (".*.stage-*", ".*.delete-*", ".*.backup-*"):
            for leftover in self.directory.glob(pattern):
                shutil.rmtree(leftover, ignore_errors=True)


def _size(value: Any) -> int:
    """Bytes of all tensors in a component of a checkpoint."""
    if isinstance(value, torch.Tensor):
        return value.numel() * value.element_size()
    if isinstance(value, ReplayBuffer):
        return value.storage[:].bytes() if len(value) else 0
    if isinstance(value, Mapping):
        return sum(map(_size, value.values()))
    if isinstance(value, (list, tuple)):
        return sum(map(_size, value))
    return _size(value.state_dict()) if hasattr(value, "state_dict") else 0


def _digests(folder: Path, *, flush: bool = False) -> dict[str, str]:
    digests = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name not in (_SEAL, f".{_SEAL}.tmp"):
            with path.open("rb") as file:
                if flush:
                    os.fsync(file.fileno())
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            digests[name] = digest
    return digests


def _fault(folder: Path) -> str | None:
    """The defect of a checkpoint folder, or ``None``."""
    try:
        sealed = json.loads((folder / _SEAL).read_text(encoding="utf-8"))
        found = _digests(folder)
    except (OSError, ValueError) as error:
        return f"{_SEAL} or another file cannot be read: {error}"
    if not isinstance(sealed, dict):
        return f"{_SEAL} holds no digests"
    foreign = [name for name in sealed if Path(name).suffix not in _PLAIN_FILES]
    if foreign:
        return f"{foreign[0]} is not a kind of file in checkpoints"
    names = sorted(found.keys() | sealed.keys())
    other = next((name for name in names if found.get(name) != sealed.get(name)), None)
    return None if other is None else f"{other} has changed since it was saved"
