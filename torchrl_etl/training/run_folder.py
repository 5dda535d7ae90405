"""The folder of a run: configuration, versions, metrics, checkpoints and figures."""

from __future__ import annotations

import itertools
import os
import platform
import shlex
import subprocess
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from filelock import FileLock, Timeout
from torchrl.record.loggers import Logger, TensorboardLogger, get_logger

from torchrl_etl.extras import extra
from torchrl_etl.io import as_json, read_json, write_atomically
from torchrl_etl.training.config import resume_setting
from torchrl_etl.user_code import find_class

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["RunFolder", "facts"]

_PACKAGES = (
    *("torchrl_etl", "torch", "torchrl", "tensordict"),
    *("gymnasium", "mujoco", "myosuite", "dm-control"),
)


class RunFolder:
    """Paths and small files of a run; nothing is written before :meth:`open`.

    The configuration's ``log`` names the loggers. With ``unique``, a number is added to the name of
    the folder if it is taken.
    """

    def __init__(self, path: Path, config: DictConfig, *, unique: bool = False) -> None:
        self.path, self._unique = Path(path).expanduser().resolve(), unique
        self._config = config
        self._loggers: list[Any] | None = None
        self._purge_step: int | None = None

    def open(self, *, resume: bool) -> None:
        """Create the folder and write the configuration and the versions to it.

        Raises:
            FileExistsError: if the folder already holds a run and ``resume`` is False.
            OSError: if the folder cannot be written.
        """
        with extra("recipes"):
            from omegaconf import OmegaConf
        try:
            if self._unique and not resume:
                self.path = _claimed(self.path)
                self._config.run_dir = str(self.path)
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(self.path / ".lock", is_singleton=True)
            self._lock.acquire(timeout=0)
            # Checked under the lock: another run may have started and finished meanwhile.
            taken = (self.path / "config.yaml").exists() and not resume
            if not taken:
                write_atomically(self.path / "config.yaml", OmegaConf.to_yaml(self._config))
        except Timeout:
            raise FileExistsError(
                f"Another process uses {self.path}; wait for it, or stop it."
            ) from None
        except OSError as error:
            raise OSError(
                f"The run folder {self.path} cannot be written ({error.strerror}); choose another "
                "run_dir or fix its permissions."
            ) from error
        if taken:
            self._lock.release()
            raise FileExistsError(
                f"{self.path} already holds a run; continue it with {self._resume}, or choose "
                "another run_dir."
            )
        # One entry per start: a run may be resumed on another machine or commit.
        self.write_json("versions.json", [*self.versions, {**facts(), "saved": self.saved}])

    def close(self) -> None:
        """Release the lock on the folder."""
        self._lock.release()

    @staticmethod
    def is_locked(path: Path) -> bool:
        """Whether some process has this folder open."""
        lock = FileLock(Path(path) / ".lock", is_singleton=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return True
        lock.release()
        return False

    def write_json(self, name: str, content: Any) -> None:
        """Write a JSON file atomically."""
        write_atomically(self.path / name, as_json(content))

    def checkpoints(self, stage: str) -> Path:
        return self.path / "checkpoints" / stage

    @property
    def versions(self) -> list[dict[str, Any]]:
        """The :func:`facts` of each start, with what was saved by then."""
        return self._read_json("versions.json", [])

    @property
    def saved(self) -> dict[str, int]:
        """Frames of each stage at its last checkpoint, even if the checkpoint was deleted."""
        return self._read_json("saved.json", {})

    def remember_saved(self, stage: str, frames: int) -> None:
        """Record in :attr:`saved` that ``stage`` has a checkpoint."""
        self.write_json("saved.json", {**self.saved, stage: frames})

    @property
    def synergies(self) -> Path:
        return self.path / "synergies"

    @property
    def explored(self) -> Path:
        """Transitions of stage 1 for stage 2."""
        return self.path / "explored.safetensors"

    @property
    def pictures(self) -> Path:
        return self.path / "pictures"

    @property
    def scalars(self) -> Path:
        return self.path / "csv" / "scalars"

    def forget_after(self, stage: str, frame: int, *, from_start: bool = False) -> None:
        """Drop rows of ``stage`` after ``frame``, which a resumed run logs again.

        If the stage starts over (``from_start``), all its rows are dropped. TensorBoard still shows
        that of ``frame``, where the stage before may have logged too.
        """
        for path in sorted((self.scalars / stage).rglob("*.csv")):
            kept = [row for row in _read(path) if row[0] <= frame and not from_start]
            write_atomically(path, "".join(f"{at},{value}\n" for at, value in kept))
        self._purge_step = frame + 1

    def log(self, values: Mapping[str, float], frame: int) -> None:
        """Log scalars at a frame count that includes earlier stages."""
        if self._loggers is None:
            # Summary and learning curves read the CSV files.
            names = dict.fromkeys(("csv", *self._config.log))
            self._loggers = [self._logger(name) for name in names]
        try:
            for logger in self._loggers:
                for key, value in values.items():
                    logger.log_scalar(key, float(value), step=frame)
        except OSError as error:
            raise OSError(
                f"The log of {self.path} cannot be written ({error.strerror or error}); fix that, "
                f"then continue with {self._resume}."
            ) from error

    @property
    def _resume(self) -> str:
        """The setting that resumes this run, quoted for a shell."""
        return shlex.quote(resume_setting([self.path]))

    def series(self, key: str) -> tuple[list[int], list[float]]:
        """Frames and values of ``key`` in the CSV log."""
        path = self.scalars / f"{key}.csv"
        rows = _read(path) if path.exists() else []
        return [frame for frame, _ in rows], [value for _, value in rows]

    def _logger(self, name: str) -> Logger:
        if name == "tensorboard":
            return _ResumableTensorboard(str(self.path), self._purge_step)
        module, _, key = name.rpartition(":")
        given = self._config.get("logger_kwargs", {}).get(key, {})
        if module:
            return find_class(name, {}, Logger)(self.path.name, str(self.path), **given)
        options = {} if name == "csv" else self._own(name)
        options |= given
        title = name if name == "csv" else self.path.name
        return get_logger(name, str(self.path), title, **{f"{name}_kwargs": options})

    def _own(self, name: str) -> dict[str, Any]:
        """Arguments by which a logger identifies this run."""
        if name == "mlflow":  # has its own store in every run folder
            return {}
        from omegaconf import OmegaConf

        config = OmegaConf.to_container(self._config, resolve=True)
        if name == "trackio":  # identifies a run by its name
            return {"config": config}
        if not (known := self._read_json("wandb.json", {})):
            self.write_json("wandb.json", known := {"id": uuid.uuid4().hex})
        return {"config": config, "id": known["id"]}

    def _read_json(self, name: str, default: Any) -> Any:
        """Content written by :meth:`write_json`, of the type of ``default``, else ``default``."""
        path = self.path / name
        if not path.exists():
            return default
        return read_json(path, type(default), OSError, "move it away to continue without it")


def _claimed(path: Path) -> Path:
    """Create a folder of this name, with a number appended if it exists."""
    numbered = (path.with_name(f"{path.name}-{number}") for number in itertools.count(2))
    for candidate in itertools.chain([path], numbered):
        try:
            candidate.mkdir(parents=True)
        except FileExistsError:
            continue
        return candidate
    raise AssertionError("numbers do not end")


class _ResumableTensorboard(TensorboardLogger):
    """TorchRL's logger plus ``purge_step`` (missing in 0.14.1), to hide rows past a checkpoint."""

    def __init__(self, log_dir: str, purge_step: int | None) -> None:
        self._purge_step = purge_step
        super().__init__("tensorboard", log_dir)

    def _create_experiment(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(os.path.join(self.log_dir, self.exp_name), purge_step=self._purge_step)


def facts() -> dict[str, Any]:
    """Versions, commit and type of machine, for reproducibility."""
    found = {"commit": _commit(), "python": platform.python_version()}
    for name in _PACKAGES:  # even torchrl_etl may not be installed, in a checkout
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    simd = torch.backends.cpu.get_cpu_capability()  # decides rounding and speed of products
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, {simd}"
    return {**found, "machine": machine}


def _commit() -> str | None:
    here = Path(__file__).parent
    git: Sequence[str] = ("git", "-C", str(here), "describe", "--always", "--dirty", "--abbrev=12")
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _read(path: Path) -> list[tuple[int, float]]:
    """Complete rows of a scalar file; skips a last row that is not fully written."""
    try:
        whole, _, _ = path.read_text(encoding="utf-8").rpartition("\n")
        rows = [line.split(",") for line in whole.splitlines()]
        return [(int(frame), float(value)) for frame, value in rows]
    except ValueError as error:
        raise OSError(
            f"{path} is damaged ({error}); move it away to continue without what it logged."
        ) from error
