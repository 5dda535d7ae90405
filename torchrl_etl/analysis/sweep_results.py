"""Evaluations of a sweep: read from one CSV file, checked row by row, grouped into runs."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchrl_etl.envs import list_tasks

__all__ = ["COLUMNS", "RESULTS", "SweepResults", "SweepRow", "SweepRun", "read_sweep"]

RESULTS = "results.csv"


class SweepRow(NamedTuple):
    """One evaluation; numbers that are empty in the file are NaN.

    Attributes:
        line: Line number in the file.
        task, goal, method, seed: The run; an empty goal is the one that an id names, else fixed.
        frames: Environment frames so far, including exploration.
        mean_return: Mean undiscounted return over the evaluation's episodes.
        solved, solved_time: Shares in [0, 1] of solved episodes and solved steps.
        episodes: Number of episodes.
        wall_seconds: Seconds since the run began.
        commit, versions, machine: Origin of the numbers.
        settings: The run's other settings, as on a command line; empty if not recorded.
        status: ``"finished"``, or another status of the run.
    """

    line: int
    task: str
    goal: str
    method: str
    seed: int
    frames: int
    mean_return: float
    solved: float
    solved_time: float
    episodes: float
    wall_seconds: float
    commit: str
    versions: Mapping[str, str]
    machine: str
    settings: str
    status: str


COLUMNS = tuple("return" if name == "mean_return" else name for name in SweepRow._fields[1:])
REQUIRED = tuple(name for name in COLUMNS if name != "settings")  # older files lack it


@dataclass(frozen=True)
class SweepRun:
    """The evaluations of one method on one task with one seed, in order of frames."""

    rows: tuple[SweepRow, ...]

    @property
    def setting(self) -> tuple[str, str]:
        """Task and goal."""
        return self.rows[0].task, self.rows[0].goal

    @property
    def method(self) -> str:
        return self.rows[0].method

    @property
    def seed(self) -> int:
        return self.rows[0].seed

    @property
    def status(self) -> str:
        """Status of the newest row."""
        return max(self.rows, key=lambda row: row.line).status

    @property
    def finished(self) -> bool:
        return self.status == "finished"

    @property
    def last_frames(self) -> int:
        return self.rows[-1].frames

    @property
    def evaluated(self) -> bool:
        return any(math.isfinite(row.mean_return) for row in self.rows)

    def evaluation_at(self, frames: int) -> SweepRow | None:
        """The last evaluation up to 1 % past ``frames``.

        Runs end with a whole batch, so slightly past their budget.
        """
        return next((row for row in reversed(self.rows) if row.frames <= 1.01 * frames), None)

    def curve(self, column: str) -> np.ndarray:
        """Frames and values of a column, [2, T], without missing values."""
        pairs = [(row.frames, getattr(row, column)) for row in self.rows]
        known = [pair for pair in pairs if math.isfinite(pair[1])]
        return np.array(known, float).reshape(-1, 2).T

    def __str__(self) -> str:
        task, goal = self.setting
        return f"{task} ({goal}), {self.method}, seed {self.seed}"


@dataclass(frozen=True)
class SweepResults:
    """Content of one file of evaluations.

    Attributes:
        runs: All runs, including unfinished ones.
        row_count: Number of evaluations in the file.
        replaced: Number of evaluations superseded by a repeated run.
    """

    runs: tuple[SweepRun, ...]
    row_count: int
    replaced: int

    @property
    def finished(self) -> tuple[SweepRun, ...]:
        return tuple(run for run in self.runs if run.finished)

    @property
    def finished_by_task(self) -> tuple[tuple[SweepRun, ...], ...]:
        """Finished runs of each pair of task and goal with any, in the order of ``settings``."""
        by_task = (
            tuple(run for run in self.finished if run.setting == each) for each in self.settings
        )
        return tuple(runs for runs in by_task if runs)

    @property
    def unfinished(self) -> tuple[SweepRun, ...]:
        return tuple(run for run in self.runs if not run.finished)

    @property
    def settings(self) -> tuple[tuple[str, str], ...]:
        """Pairs of task and goal: the paper's tasks in the paper's order, then others by name."""
        order = {task.name: index for index, task in enumerate(list_tasks())}
        found = {run.setting for run in self.runs}
        return tuple(sorted(found, key=lambda pair: (order.get(pair[0], len(order)), *pair)))


def read_sweep(folder: str | os.PathLike[str]) -> SweepResults:
    """Read ``results.csv`` of a sweep's folder.

    A run may have been repeated. Among rows with the same task, goal, method, seed and frames, the
    last one in the file counts. If a run has such repeated rows, its rows beyond the frames of its
    last row are dropped as well. A row at frame 0 without a return, as before the first evaluation,
    counts only if the run has no other rows.

    Raises:
        FileNotFoundError: if the folder or the file is missing.
        ValueError: if the file has no rows, lacks columns or has an invalid line, or if an
            evaluation of a finished run has no return.
    """
    folder = Path(folder)
    path = folder / RESULTS
    if not folder.is_dir():
        raise FileNotFoundError(f"There is no folder {folder}; pass the one that the sweep wrote.")
    if not path.is_file():
        raise FileNotFoundError(f"{folder} has no {RESULTS}; pass the folder that the sweep wrote.")
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        missing = [name for name in REQUIRED if name not in (reader.fieldnames or ())]
        if reader.fieldnames and missing:
            raise ValueError(
                f"{path} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; it needs "
                f"{', '.join(REQUIRED)}."
            )
        rows = [_row(path, reader.line_num, cells) for cells in reader]
    if not rows:
        raise ValueError(f"{path} has no rows; evaluate at least one run first.")
    runs, kept = _runs(rows), 0
    for run in runs:
        kept += _evaluations(run.rows)
        for row in run.rows:
            if run.finished and not math.isfinite(row.mean_return):
                raise ValueError(
                    f"{path}, line {row.line}: {run} is finished but this evaluation has no finite "
                    "return; fix the row, or give the run's last row another status."
                )
    evaluations = _evaluations(rows)
    return SweepResults(runs, evaluations, evaluations - kept)


def _evaluations(rows: Iterable[SweepRow]) -> int:
    return sum(math.isfinite(row.mean_return) for row in rows)


def _runs(rows: list[SweepRow]) -> tuple[SweepRun, ...]:
    found: dict[tuple[Any, ...], list[SweepRow]] = {}
    for row in rows:
        found.setdefault((row.task, row.goal, row.method, row.seed), []).append(row)
    runs = []
    for of_run in found.values():
        attempts = [r for r in of_run if r.frames or math.isfinite(r.mean_return)] or of_run
        latest = {row.frames: row for row in attempts}
        if len(latest) < len(attempts):
            reached = attempts[-1].frames
            latest = {frames: row for frames, row in latest.items() if frames <= reached}
        runs.append(SweepRun(tuple(latest[frames] for frames in sorted(latest))))
    return tuple(sorted(runs, key=lambda run: (*run.setting, run.method, run.seed)))


def _row(path: Path, line: int, cells: Mapping[str | None, Any]) -> SweepRow:
    where = f"{path}, line {line}"
    if None in cells or None in cells.values():
        raise ValueError(
            f"{where}: the line does not have as many cells as the header; complete or delete it "
            "(a writer that was killed leaves half a line)."
        )
    text = {name: cells.get(name, "").strip() for name in COLUMNS}
    for name in ("task", "method", "status"):
        if not text[name]:
            raise ValueError(f"{where}: {name} is empty; every evaluation needs one.")
    read = {name: parse(where, name, text[name]) for name, parse in _PARSERS.items()}
    goal = text["goal"] or ("random" if "Random" in text["task"] else "fixed")
    return SweepRow(line, *(text | read | {"goal": goal}).values())


def _number(where: str, name: str, text: str) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError as error:
        raise ValueError(f"{where}: {name} is {text!r}; it must be a number.") from error


def _integer(where: str, name: str, text: str) -> int:
    value = _number(where, name, text)
    if not (math.isfinite(value) and value >= 0 and value == int(value)):
        raise ValueError(f"{where}: {name} is {text!r}; it must be a whole number, 0 or more.")
    return int(value)


def _share(where: str, name: str, text: str) -> float:
    value = _number(where, name, text)
    if value < 0 or value > 1:
        raise ValueError(f"{where}: {name} is {text}; it must be a share in [0, 1], or empty.")
    return value


def _versions(where: str, name: str, text: str) -> Mapping[str, str]:
    try:
        versions = json.loads(text or "{}")
    except json.JSONDecodeError as error:
        raise ValueError(f"{where}: {name} is not valid JSON ({error}).") from error
    if not isinstance(versions, dict):
        raise ValueError(f"{where}: {name} must be a JSON object that maps names to versions.")
    return {str(name): str(version) for name, version in versions.items()}


_PARSERS: dict[str, Callable[[str, str, str], Any]] = {
    "seed": _integer,
    "frames": _integer,
    "solved": _share,
    "solved_time": _share,
    "return": _number,
    "episodes": _number,
    "wall_seconds": _number,
    "versions": _versions,
}
