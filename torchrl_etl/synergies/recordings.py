"""Read recordings of muscle activity: tables with one column per muscle."""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

__all__ = ["Recording", "read_recording"]

_MISSING = ("", "na", "n/a", "nan", "null", "none", "-")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?", re.IGNORECASE)


class Recording(NamedTuple):
    """Activity of n muscles at N times.

    Attributes:
        muscles (tuple of str): names, in the order of the columns.
        activity (np.ndarray): [N, n], as recorded.
        trials (np.ndarray, optional): the trial of each row [N], as strings.
    """

    muscles: tuple[str, ...]
    activity: np.ndarray
    trials: np.ndarray | None = None


def read_recording(
    path: str | os.PathLike[str], *, trial: str | None = None, leave_out: Sequence[str] = ()
) -> Recording:
    """Read muscle activity from a ``.csv``, ``.npy`` or ``.npz`` file.

    - ``.csv``: the first line names the columns, which are separated by commas, semicolons or tabs.
    - ``.npz``: one array [N] per muscle with its name, or one array [N, n] and ``names`` [n].
    - ``.npy``: an array [N, n], or [N] with named fields.

    Muscles without names are called ``muscle_0`` and so on. No code in a file is executed.

    Args:
        path (path-like): the file.

    Keyword Args:
        trial (str, optional): the column (or array [N]) with the trial of each row.
            Default: ``"trial"``, if there is one.
        leave_out (sequence of str): columns that are not muscles, such as time.

    Returns:
        Recording: all numbers are finite, and every muscle varies.

    Raises:
        OSError: if the file cannot be read.
        ValueError: for another file type, rows of different lengths, missing values, decimal
            commas, a muscle that never varies, or duplicate or missing names. Messages give the
            line in a ``.csv`` file, or the row index from 0 in an array.

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
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".npy", ".npz"):
        raise ValueError(
            f"{path} is not a recording that can be read; pass a .csv, .npy or .npz file."
        )
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}; pass the path of a recording.")
    columns, lines = (
        _read_csv(path) if suffix == ".csv" else (_read_numpy(path, trial or "trial"), None)
    )
    for name in (named := Counter(name for name, _ in columns)):
        if named[name] > 1:
            raise ValueError(f"{path} has {named[name]} columns {name!r}; give each its own name.")
    for name in (*leave_out, *([trial] if trial else [])):
        if name not in named:
            raise ValueError(f"{path} has no column {name!r}; it has {', '.join(named)}.")
    trial = trial or "trial"
    trials = next((_text(np.asarray(c)) for name, c in columns if name == trial), None)
    if trials is not None:
        for row, name in enumerate(trials):
            if name.strip().lower() in _MISSING:
                raise ValueError(
                    f"{path} has no {trial} in {_place(lines, row)}; fill it in, or leave the row "
                    "out."
                )
    columns = [(name, c) for name, c in columns if name != trial and name not in leave_out]
    if not columns:
        raise ValueError(f"{path} has no muscle columns; pass a file that has some.")
    activity = np.stack([_numbers(path, name, column, lines) for name, column in columns], -1)
    muscles = tuple(name for name, _ in columns)
    _check(path, muscles, activity, lines)
    return Recording(muscles, activity, trials)


Columns = list[tuple[str, "np.ndarray | list[str]"]]
# The line of the file on which each row begins; ``None`` for arrays.
Lines = list[int] | None


def _read_csv(path: Path) -> tuple[Columns, Lines]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text ({error.reason}); save it as UTF-8.") from error
    head = lines[0] if lines else ""
    rows = _rows(path, lines, max("\t;,", key=head.count))
    names = [name.strip() for name in rows[0][1]] if rows else []
    if not any(names) or all(map(_is_number, names)):
        raise ValueError(
            f"The first line of {path} names no columns; write the name of each muscle there."
        )
    if "" in names:
        raise ValueError(
            f"Column {names.index('') + 1} of {path} has no name in the first line; name it, or "
            "leave it out of the file if it is empty or counts the rows."
        )
    rows = [(number, row) for number, row in rows[1:] if row]
    for number, row in rows:
        if len(row) != len(names):
            raise ValueError(
                f"Line {number} of {path} has {len(row)} entries but the first line {len(names)}; "
                "complete it or leave it out."
            )
    columns: Columns = [(name, [row[i].strip() for _, row in rows]) for i, name in enumerate(names)]
    return columns, [number for number, _ in rows]


def _rows(path: Path, lines: list[str], delimiter: str) -> list[tuple[int, list[str]]]:
    """The rows of a table, each with the line on which it begins, counted from 1."""
    # Without strict, an unclosed quotation mark would swallow the rest of the file.
    reader = csv.reader(lines, delimiter=delimiter, strict=True)
    rows, first = [], 1
    try:
        for row in reader:
            rows.append((first, row))
            first = reader.line_num + 1
    except csv.Error as error:
        raise ValueError(
            f"Line {first} of {path} has unmatched quotation marks ({error}); write numbers "
            "without, and names with one at each end."
        ) from error
    return rows


def _read_numpy(path: Path, trial: str) -> Columns:
    archive = _load(path)
    if isinstance(archive, np.ndarray):
        return _columns(path, archive)
    matrices = [name for name, array in archive.items() if array.ndim == 2]
    if not matrices:
        columns: Columns = [pair for pair in archive.items() if pair[1].ndim == 1]
        if len(lengths := {len(column) for _, column in columns}) > 1:
            raise ValueError(
                f"The arrays of {path} have {' and '.join(map(str, sorted(lengths)))} rows; they "
                "must have the same number of rows."
            )
        return columns
    if len(matrices) > 1:
        raise ValueError(
            f"{path} has the arrays {', '.join(matrices)}; keep only the one with a column for "
            "each muscle."
        )
    matrix = archive.pop(matrices[0])
    names = archive.pop("names", None)
    if names is not None and names.shape != matrix.shape[1:]:
        raise ValueError(
            f"{path} has {names.size} names for the {matrix.shape[1]} columns of {matrices[0]}; "
            "pass one for each."
        )
    if trial in archive and archive[trial].shape != matrix.shape[:1]:
        raise ValueError(
            f"{path} has {archive[trial].size} entries of {trial!r} for the {len(matrix)} rows of "
            f"{matrices[0]}; pass one for each."
        )
    beside = [pair for pair in archive.items() if pair[1].shape == matrix.shape[:1]]
    return _columns(path, matrix, names) + beside


def _load(path: Path) -> np.ndarray | dict[str, np.ndarray]:
    try:
        loaded = np.load(path, allow_pickle=False)
        if not isinstance(loaded, np.lib.npyio.NpzFile):
            return loaded
        with loaded:
            found = {name: loaded[name] for name in loaded.files}
            # Of a file that is no array, NumPy hands out the bytes.
            return {name: array for name, array in found.items() if isinstance(array, np.ndarray)}
    except OSError:
        raise
    # A damaged file can ask for a password, an unknown compression or all memory, and not parse.
    except Exception as error:
        raise ValueError(
            f"{path} does not hold arrays of numbers ({error}); save it with numpy.save or "
            "numpy.savez, without objects."
        ) from error


def _columns(path: Path, array: np.ndarray, names: np.ndarray | None = None) -> Columns:
    if array.dtype.names and array.ndim == 1:
        return [(name, array[name]) for name in array.dtype.names]
    if array.ndim != 2:
        raise ValueError(
            f"{path} holds an array of shape {array.shape}; it must be [rows, muscles]."
        )
    width = array.shape[1]
    named = [f"muscle_{i}" for i in range(width)] if names is None else _text(names).tolist()
    return list(zip(named, array.T, strict=True))


def _text(array: np.ndarray) -> np.ndarray:
    """An array as text; bytes, as of fixed width, are read as UTF-8."""
    if array.dtype.kind == "S":
        return np.char.decode(array, "utf-8", "replace")
    return array.astype(str)


def _numbers(path: Path, name: str, column: np.ndarray | list[str], lines: Lines) -> np.ndarray:
    """A column in double precision, with NaN for missing values."""
    if isinstance(column, list):
        column = ["nan" if entry.lower() in _MISSING else entry for entry in column]
        wrong = next((i for i, entry in enumerate(column) if not _is_number(entry)), None)
        if wrong is not None and _DECIMAL_COMMA.fullmatch(entry := column[wrong]):
            raise ValueError(
                f"{name!r} in {path} has a decimal comma in {_place(lines, wrong)}; use decimal "
                f"points in the whole file, {entry.replace(',', '.')} instead of {entry}."
            )
        if wrong is not None:
            raise ValueError(
                f"{name!r} in {path} has {column[wrong]!r}, not a number, in "
                f"{_place(lines, wrong)}; if it is not a muscle, leave it out with "
                f"{_leave_out(name)}."
            )
    elif column.dtype.kind not in "fiub":
        raise ValueError(
            f"{name!r} in {path} is of type {column.dtype}, not real numbers; if it is not a "
            f"muscle, leave it out with {_leave_out(name)}."
        )
    return np.asarray(column, dtype=np.float64)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _leave_out(*names: str) -> str:
    """The setting in shell syntax, quoted if a name contains special characters."""
    if all(re.fullmatch(r"\w+", name) for name in names):
        return f"leave_out=[{','.join(names)}]"
    listed = ",".join(f"'{name}'" for name in names)
    return f'"leave_out=[{listed}]"'


def _place(lines: Lines, row: int) -> str:
    """Location of a row for an error message."""
    return f"row {row}" if lines is None else f"line {lines[row]}"


def _check(path: Path, muscles: Sequence[str], activity: np.ndarray, lines: Lines) -> None:
    if len(activity) < 2:
        raise ValueError(
            f"{path} has {len(activity)} row(s), too few to find synergies; record more."
        )
    rows, columns = np.nonzero(~np.isfinite(activity))
    if rows.size:
        more = f", one of {rows.size} such places" if rows.size > 1 else ""
        raise ValueError(
            f"{muscles[columns[0]]!r} in {path} has no value in {_place(lines, rows[0])}{more}; "
            "fill what is missing or leave these rows out."
        )
    constant = [
        name for name, still in zip(muscles, np.ptp(activity, 0) == 0, strict=True) if still
    ]
    if constant:
        raise ValueError(
            f"{constant[0]!r} in {path} has the same value in every row; leave it out with "
            f"{_leave_out(*constant)}."
        )
