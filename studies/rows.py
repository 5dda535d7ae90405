"""Rows of a study, added to a CSV file as they are finished."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

__all__ = ["append"]


def append(out: Path, row: dict[str, Any]) -> None:
    """Add a row to a file, which begins with the names of its columns."""
    fresh = not out.exists()
    with out.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row, lineterminator="\n")
        if fresh:
            writer.writeheader()
        writer.writerow(row)
