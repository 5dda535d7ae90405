"""Recordings of muscles as laboratories keep them: tables with a column for each muscle."""

from __future__ import annotations

import csv
import os
import zipfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

__all__ = ["Recording", "read_recording"]

_MISSING = ("", "na", "n/a", "nan", "null", "none", "-")


class Recording(NamedTuple):
    """Activity of n muscles at N times.

    Attributes:
        muscles (tuple of str): names, in the order of the columns.
        activity (np.ndarray): [N, n], as it was recorded.
        trials (np.ndarray, optional): the trial of each row [N], as text.
    """

    muscles: tuple[str, ...]
    activity: np.ndarray
    trials: np.ndarray | None = None


def read_recording(
    path: str | os.PathLike[str], *, trial: str | None = None, leave_out: Sequence[str] = ()
) -> Recording:
    """Read activity of muscles from a ``.csv``, ``.npy`` or ``.npz`` file.

    - ``.csv``: the first line names the columns, which are separated by commas, semicolons or tabs.
    - ``.npz``: arrays [N] by the names of their muscles, or one array [N, n] and ``names`` [n].
    - ``.npy``: an array [N, n], or [N] with named fields.

    Muscles without names are ``muscle_0`` and so on. No code in a file is run.

    Args:
        path (path-like): the file.

    Keyword Args:
        trial (str, optional): the column (or array [N]) that says which trial a row belongs to.
            Default: ``"trial"``, if there is one.
        leave_out (sequence of str): columns that are not muscles, such as the time.

    Returns:
        Recording: its numbers are finite, and every muscle varies.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is of another kind, has rows of different lengths, missing values, a
            muscle that never varies, or names twice.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "emg.csv"
        ...     _ = path.write_text("time,soleus,tibialis\\n0.0,0.1,0.4\\n0.1,0.2,0.3\\n")
        ...     recording = read_recording(path, leave_out=["time"])
        >>> recording.muscles, recording.activity.shape, recording.trials
        (('soleus', 'tibialis'), (2, 2), None)
    """
    path = Path(path)
    readers = {".csv": _read_csv, ".npy": _read_npy, ".npz": _read_npz}
    if path.suffix.lower() not in readers:
        raise ValueError(
            f"{path} is not a recording that can be read; pass a .csv, .npy or .npz file."
        )
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}; pass the path of a recording.")
    columns = readers[path.suffix.lower()](path)
    for name in (named := Counter(name for name, _ in columns)):
        if named[name] > 1:
            raise ValueError(f"{path} has {named[name]} columns {name!r}; give each its own name.")
    for name in (*leave_out, *([trial] if trial else [])):
        if name not in named:
            raise ValueError(f"{path} has no column {name!r}; it has {', '.join(named)}.")
    trial = trial or "trial"
    trials = next((np.asarray(c).astype(str) for name, c in columns if name == trial), None)
    columns = [(name, c) for name, c in columns if name != trial and name not in leave_out]
    if not columns:
        raise ValueError(f"{path} has no column that is a muscle; pass a file that has some.")
    activity = np.stack([_numbers(path, name, column) for name, column in columns], -1)
    muscles = tuple(name for name, _ in columns)
    _check(path, muscles, activity)
    return Recording(muscles, activity, trials)


Columns = list[tuple[str, "np.ndarray | list[str]"]]


def _read_csv(path: Path) -> Columns:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text in UTF-8 ({error.reason}); save it so.") from error
    head = lines[0] if lines else ""
    rows = list(csv.reader(lines, delimiter=max(",;\t", key=head.count)))
    names = [name.strip() for name in rows[0]] if rows else []
    if not any(names) or all(map(_is_number, names)):
        raise ValueError(
            f"The first line of {path} names no columns; write the name of each muscle there."
        )
    rows = [(number, row) for number, row in enumerate(rows[1:], 2) if row]
    for number, row in rows:
        if len(row) != len(names):
            raise ValueError(
                f"Line {number} of {path} has {len(row)} entries and the first line {len(names)}; "
                "complete it or leave it out."
            )
    return [(name, [row[i].strip() for _, row in rows]) for i, name in enumerate(names)]


def _read_npy(path: Path) -> Columns:
    return _columns(path, _load(path))


def _read_npz(path: Path) -> Columns:
    archive = _load(path)
    matrices = [name for name, array in archive.items() if array.ndim == 2]
    if not matrices:
        columns = [pair for pair in archive.items() if pair[1].ndim == 1]
        if len(lengths := {len(column) for _, column in columns}) > 1:
            raise ValueError(
                f"The arrays of {path} have {' and '.join(map(str, sorted(lengths)))} rows; they "
                "must have as many as each other."
            )
        return columns
    if len(matrices) > 1:
        raise ValueError(
            f"{path} has the arrays {', '.join(matrices)}; keep the one that holds a column for "
            "each muscle."
        )
    matrix = archive.pop(matrices[0])
    names = archive.pop("names", None)
    if names is not None and names.shape != matrix.shape[1:]:
        raise ValueError(
            f"{path} has {names.size} names for the {matrix.shape[1]} columns of {matrices[0]}; "
            "pass one for each."
        )
    beside = [pair for pair in archive.items() if pair[1].shape == matrix.shape[:1]]
    return _columns(path, matrix, names) + beside


def _load(path: Path) -> np.ndarray | dict[str, np.ndarray]:
    try:
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            return loaded
        with loaded:
            return {name: loaded[name] for name in loaded.files}
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} does not hold arrays of numbers ({error}); save it with numpy.save or "
            "numpy.savez, without objects."
        ) from error


def _columns(path: Path, array: np.ndarray, names: np.ndarray | None = None) -> Columns:
    if array.dtype.names:
        return [(name, array[name]) for name in array.dtype.names]
    if array.ndim != 2:
        raise ValueError(
            f"{path} holds an array of shape {array.shape}; it must be [rows, muscles]."
        )
    width = array.shape[1]
    named = [f"muscle_{i}" for i in range(width)] if names is None else map(str, names)
    return list(zip(named, array.T, strict=True))


def _numbers(path: Path, name: str, column: np.ndarray | list[str]) -> np.ndarray:
    """A column in double precision; what is missing is NaN."""
    if isinstance(column, list):
        column = ["nan" if entry.lower() in _MISSING else entry for entry in column]
        wrong = next((i for i, entry in enumerate(column) if not _is_number(entry)), None)
        if wrong is not None:
            raise ValueError(
                f"Row {wrong} of {name!r} in {path} is {column[wrong]!r}, not a number; if it is "
                f"not a muscle, leave it out with leave_out=[{name}]."
            )
    elif column.dtype.kind not in "fiub":
        raise ValueError(
            f"{name!r} in {path} is of type {column.dtype}, not real numbers; if it is not a "
            f"muscle, leave it out with leave_out=[{name}]."
        )
    return np.asarray(column, dtype=np.float64)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check(path: Path, muscles: Sequence[str], activity: np.ndarray) -> None:
    if len(activity) < 2:
        raise ValueError(
            f"{path} has {len(activity)} row(s), in which no synergies can be found; record more."
        )
    rows, columns = np.nonzero(~np.isfinite(activity))
    if rows.size:
        more = f", one of {rows.size} such places" if rows.size > 1 else ""
        raise ValueError(
            f"{muscles[columns[0]]!r} in {path} has no value in row {rows[0]}{more}; fill what is "
            "missing or leave these rows out."
        )
    constant = [
        name for name, still in zip(muscles, np.ptp(activity, 0) == 0, strict=True) if still
    ]
    if constant:
        raise ValueError(
            f"{constant[0]!r} in {path} has the same value in every row; leave it out with "
            f"leave_out=[{','.join(constant)}]."
        )
