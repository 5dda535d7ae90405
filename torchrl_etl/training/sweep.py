"""A queue of runs that can be killed and restarted at any time."""

from __future__ import annotations

import csv
import ctypes
import io
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from torchrl_etl.analysis.sweep_results import COLUMNS, RESULTS
from torchrl_etl.io import write_atomically
from torchrl_etl.training.config import resume_setting
from torchrl_etl.training.run_folder import RunFolder

__all__ = ["Run", "Sweep", "end_with_parent"]

SETTINGS = "settings.txt"
KEY = ("task", "goal", "method", "seed")
SET_BY_KEY = ("env=", "goal=", "method=", "seed=")
EARLIER_STAGES = ("explore", "play")


@dataclass
class Run:
    """One method on one task with one seed, in a folder of its own.

    Attributes:
        task, goal, method, seed: identify the run; ``goal`` may be ``None``.
        path (Path): the run folder.
        command (sequence of str): command of the run, without ``run_dir`` and ``frames``.
        frames (int): budget of the run.
    """

    task: str
    goal: str | None
    method: str
    seed: int
    path: Path
    command: Sequence[str] = field(repr=False)
    frames: int
    process: subprocess.Popen | None = field(default=None, repr=False)
    leader: Run | None = field(default=None, repr=False)
    starts: int = 0

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def key(self) -> tuple[str, ...]:
        """Identifies the run's rows in the table."""
        return _key(vars(self))

    @property
    def is_finished(self) -> bool:
        """Whether it finished with at least its current budget."""
        path = self.path / "summary.json"
        if not path.is_file():
            return False
        learned = json.loads(path.read_text("utf-8")).get("learn")  # none with stage=explore
        return learned is None or learned["frames_charged"] >= self.frames

    @property
    def has_begun(self) -> bool:
        return (self.path / "config.yaml").is_file()

    def check_settings(self, rows: Sequence[Mapping[str, str]] = ()) -> None:
        """Check that the run in this folder, or in rows of a table, has these settings.

        Raises:
            ValueError: if it was started with other settings.
        """
        path, asked = self.path / SETTINGS, self.command[1:]
        begun = path.read_text("utf-8").splitlines() if self.has_begun and path.is_file() else asked
        other = {*begun} ^ {*asked}
        for row in rows:
            if _key(row) == self.key and (known := row.get("settings")):
                other |= {*shlex.split(known)} ^ {*self.settings(*SET_BY_KEY)}
        if other:
            raise ValueError(
                f"{self.path} was started with other settings ({', '.join(sorted(other))}); pass "
                "another out=FOLDER, or the settings that it was started with."
            )

    @property
    def is_busy(self) -> bool:
        """Whether a process uses its folder, perhaps one of an earlier queue."""
        return self.path.is_dir() and RunFolder.is_locked(self.path)

    @property
    def folder(self) -> RunFolder | None:
        """Its run folder, for reading logs, once it has started."""
        from omegaconf import OmegaConf

        # Read every second, so skip the configuration, which takes 30 ms to parse.
        return RunFolder(self.path, OmegaConf.create()) if self.has_begun else None

    @cached_property
    def episodes(self) -> int:
        """Episodes per evaluation; requires a run that has started."""
        from omegaconf import OmegaConf

        return OmegaConf.load(self.path / "config.yaml").evaluation.episodes

    def settings(self, *without: str) -> tuple[str, ...]:
        """Settings in its command that do not begin with one of ``without``."""
        return tuple(each for each in self.command[1:] if not each.startswith(without))

    @property
    def stem(self) -> str:
        """Its path without a seed at the end."""
        return str(self.path).removesuffix(str(self.seed))

    @property
    def log(self) -> Path:
        """Output of its process, in the folder of the first seed if several share the process."""
        return (self.leader or self).path / "log.txt"

    def rows(self, status: str) -> Iterator[dict[str, Any]]:
        """Rows of the table, one per evaluation, oldest first."""
        folder = self.folder
        if folder is None or not (starts := folder.versions):
            return
        own: dict[str, Any] = {"task": self.task, "goal": self.goal, "method": self.method}
        own |= {"seed": self.seed, "status": status}
        own["settings"] = shlex.join(self.settings(*SET_BY_KEY))
        before = sum(sum(folder.series(f"{s}/wall_seconds")[1][-1:]) for s in EARLIER_STAGES)
        own["episodes"] = self.episodes
        series = {
            key: dict(zip(*folder.series(f"learn/eval/{key}"), strict=True))
            for key in ("return", "solved", "solved_time", "wall_seconds")
        }
        begun = min(series["return"], default=0)
        for frames in sorted(series["return"]):
            row = own | {"frames": frames} | {k: v.get(frames) for k, v in series.items()}
            row |= _made_with(starts, frames - begun)
            if row["wall_seconds"] is not None:
                row["wall_seconds"] += before
            yield row


def _made_with(starts: Sequence[Mapping[str, Any]], frames: int) -> dict[str, str]:
    """What stood at the last start before so many frames of learning."""
    before = [each for each in starts if each.get("saved", {}).get("learn", -1) < frames]
    own = dict((before or starts)[-1])
    own.pop("saved", None)
    made_with = {name: own.pop(name) for name in ("commit", "machine")}
    return made_with | {"versions": json.dumps(own)}


def start(runs: Sequence[Run], environ: Mapping[str, str]) -> None:
    """Start or resume a run, or several that differ only in seed, in one process."""
    first, *others = runs
    script, *settings = first.command
    if first.has_begun:
        where, settings = resume_setting([run.path for run in runs]), []
    elif others:
        where = f"run_dir={first.stem}${{seed}}"
        settings = [*first.settings("seed="), f"seeds=[{','.join(str(run.seed) for run in runs)}]"]
    else:
        where = f"run_dir={first.path}"
    for run in runs:
        run.starts, run.leader = run.starts + 1, first
        run.path.mkdir(parents=True, exist_ok=True)
        if not run.has_begun:
            write_atomically(run.path / SETTINGS, "\n".join(run.command[1:]))
    command = [sys.executable, script, where, f"frames={first.frames}", *settings]
    with first.log.open("a", encoding="utf-8") as log:
        # In a separate session, so that only the queue handles a Ctrl-C in the terminal.
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=dict(environ),
            start_new_session=True,
            preexec_fn=end_with_parent,
        )
    for run in runs:
        run.process = process


class Sweep:
    """Runs a queue with several processes at a time and keeps one table of all evaluations.

    Finished runs are skipped, even if only their rows in the table exist. Unfinished runs and those
    with a smaller budget resume from their last checkpoint. A failed run is restarted, up to
    ``attempts`` starts in all. If the queue ends for any reason, its runs end too.

    Args:
        runs (sequence of Run): the runs, in order.
        folder (path): holds the runs' folders and ``results.csv``.

    Keyword Args:
        jobs (int): maximum number of processes at a time.
        attempts (int): maximum number of starts of one run. Default: 3.
        seeds_at_once (bool): share a process between runs that differ only in seed and whose paths
            end with it; on a GPU they are updated in one pass. A run that fails there is restarted
            alone. Default: ``False``.

    Raises:
        ValueError: if a run was started earlier with other settings, or the table in the folder has
            other columns.
        RuntimeError: if another queue uses this folder.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        folder: Path,
        *,
        jobs: int,
        attempts: int = 3,
        seeds_at_once: bool = False,
    ) -> None:
        self.runs, self.folder, self.jobs, self.attempts = runs, Path(folder), jobs, attempts
        rows = self._read()
        for run in runs:
            run.check_settings(rows)
        self.seeds_at_once = seeds_at_once
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self.folder / ".lock")
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise RuntimeError(
                f"Another queue uses {self.folder}; wait for it, or pass another folder."
            ) from None
        # Rows of earlier queues, perhaps copied from other machines without the run folders.
        own = {run.key for run in runs}
        self._earlier = [row for row in self._read() if row["return"] or _key(row) not in own]
        ended = (row for row in self._earlier if row["status"] == "finished")
        self._done = {_key(row): float(row["frames"]) for row in ended}  # frames of the last row

    def __iter__(self) -> Iterator[Sequence[Run]]:
        """Run the queue; yields about once a second, for a display."""
        environ = os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
        written = -math.inf
        try:
            while True:
                active = [run for run in self.runs if self.status(run) == "running"]
                waiting = [run for run in self.runs if self.status(run) == "waiting"]
                groups = self._divided(waiting)
                free = [runs for runs in groups if not any(run.is_busy for run in runs)]
                for runs in free[: self.jobs - len({run.process for run in active})]:
                    start(runs, environ)
                if time.monotonic() - written > 10:
                    self.write()
                    written = time.monotonic()
                yield self.runs
                if not active and not waiting:
                    return
                time.sleep(1.0)
        finally:
            self.stop()

    def _divided(self, runs: Sequence[Run]) -> list[list[Run]]:
        """Group runs that share a process."""
        shared: dict[tuple[Any, ...], list[Run]] = {}
        for run in runs:
            alone = run.starts or not self.seeds_at_once or run.stem == str(run.path)
            what = run.stem, run.settings("seed="), run.frames, run.has_begun
            shared.setdefault((*what, run.seed if alone else None), []).append(run)
        return list(shared.values())

    def status(self, run: Run) -> str:
        """Status of a run: waiting, running, finished or failed."""
        if run.process is not None and run.process.poll() is None:
            return "running"
        if run.is_finished or self._done.get(run.key, -math.inf) >= run.frames:
            return "finished"
        return "failed" if run.starts >= self.attempts else "waiting"

    def stop(self) -> None:
        """Ask running processes to save and exit, wait for them, and write the table."""
        active = {run.process for run in self.runs if run.process and self.status(run) == "running"}
        for process in active:
            process.send_signal(signal.SIGTERM)
        for process in active:
            try:
                process.wait(120)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.write()
        self._lock.release()

    def write(self) -> None:
        """Write one row per evaluation of every run, and keep rows of other runs in the table.

        A run without an evaluation that has not finished gets a row without a return.
        """
        rows: list[dict[str, Any]] = []
        for run in self.runs:
            found = list(run.rows(self.status(run)))
            # Rows of a run that finished elsewhere stay until this folder's run is as long.
            if found and found[-1]["frames"] >= self._done.get(run.key, 0):
                rows += found
        mine = {_key(row) for row in rows}
        known = mine | {_key(row) for row in self._earlier}
        for run in self.runs:
            if run.key not in known and (status := self.status(run)) != "finished":
                own = dict(zip(KEY, run.key, strict=True))
                rows.append(own | {"frames": 0, "status": status})
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(row for row in self._earlier if _key(row) not in mine)
        writer.writerows(rows)
        write_atomically(self.folder / RESULTS, text.getvalue())

    def _read(self) -> list[dict[str, str]]:
        path = self.folder / RESULTS
        if not path.is_file():
            return []
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            rows, columns = list(reader), reader.fieldnames or COLUMNS
        if {*columns, "settings"} != {*COLUMNS}:  # older files lack it
            raise ValueError(
                f"{path} has the columns {', '.join(columns)}; it must have "
                f"{', '.join(COLUMNS)}, so mend or rename it, or pass another out=FOLDER."
            )
        return rows


def _key(row: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple("" if row[name] is None else str(row[name]) for name in KEY)


def end_with_parent() -> None:
    """On Linux, receive SIGTERM when the parent process dies; a run then saves and exits."""
    if sys.platform == "linux":
        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGTERM)
