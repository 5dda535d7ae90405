"""Appends finished rows of a study to a CSV file."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

__all__ = ["append"]


def append(out: Path, row: dict[str, Any]) -> None:
    """Append a row to a file; a new file begins with the column names.

    Raises:
        ValueError: if the file has other columns.
    """
    fresh = not out.exists()
    if not fresh:
        with out.open(newline="", encoding="utf-8") as file:
            columns = next(csv.reader(file), [])
        if columns != [*row]:
            raise ValueError(
                f"{out} has the columns {', '.join(columns)}, but the row has {', '.join(row)}; "
                "pass another file."
            )
    with out.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row, lineterminator="\n")
        if fresh:
            writer.writeheader()
        writer.writerow(row)
