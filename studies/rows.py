"""Appends finished rows of a study to a CSV file."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

__all__ = ["append"]


def append(out: Path, row: dict[str, Any]) -> None:
    """Append a row to a file; a new file begins with the column names."""
    fresh = not out.exists()
    with out.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, row, lineterminator="\n")
        if fresh:
            writer.writeheader()
        writer.writerow(row)
