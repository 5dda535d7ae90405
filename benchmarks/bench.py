"""Runs the benchmarks in sequence and writes their results to docs/performance.md.

python benchmarks/bench.py                       # all, as JSON lines
python benchmarks/bench.py --only collection     # one of them
python benchmarks/bench.py --write               # also write the page and its JSON lines
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from peers import PYTHON, peer_python

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "performance.md"
LINES = HERE.parent / "docs" / "results" / "performance.jsonl"
OPTIONS: dict[str, list[str]] = {
    "collection": [],
    "update": ["--compile", "--repeats", "5"],
    "end_to_end": [],
    "start": [],
    "transforms": [],
    "memory": [],
}
WITH_PEERS = ("update", "end_to_end", "start")
BEGIN, END = "<!-- table: make bench -->\n", "<!-- end of table -->\n"
Row = dict[str, Any]


def run(name: str, peer: str | Path) -> list[Row]:
    command = [sys.executable, HERE / f"{name}.py", *OPTIONS[name]]
    if name in WITH_PEERS:
        command += ["--peer", peer]
    rows = []
    # Each benchmark sets its own number of threads.
    env = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as process:
        for text in process.stdout:
            if text.startswith("{"):
                print(text, end="", flush=True)
                rows.append(json.loads(text))
    if process.returncode:
        raise SystemExit(f"Error: {name}.py ended with {process.returncode}.")
    return rows


def table(rows: Iterable[Row]) -> str:
    lines = ["| benchmark | case | median | ± | unit | ratio to |", "|---|---|---|---|---|---|"]
    for row in rows:
        figures = f"{row['median']:,.4g} | {row['spread']:.2g} | {row['unit']}"
        ratios = [
            f"{ratio:.2f} ± {spread:.2f} `{name}`"
            for name, (ratio, spread) in row.get("ratios", {}).items()
        ]
        case = f"| {row['benchmark']} | `{row['case']}` |"
        lines.append(f"{case} {figures} | {'<br>'.join(ratios)} |")
    return "\n".join(lines) + "\n"


def written() -> list[Row]:
    """The rows from earlier runs."""
    return [json.loads(text) for text in LINES.read_text(encoding="utf-8").splitlines()]


def write(rows: list[Row]) -> None:
    LINES.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    PAGE.write_text(before + BEGIN + table(rows) + END + rest.split(END)[1], encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=OPTIONS, default=list(OPTIONS))
    parser.add_argument("--peer", default=PYTHON, help="Python of the peers, or none")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    if set(arguments.only) & set(WITH_PEERS):
        peer_python(arguments.peer)
    rows = []
    for name in arguments.only:
        rows += run(name, arguments.peer)
    if arguments.write:  # rows of benchmarks that were not run are kept
        kept = [row for row in written() if row["benchmark"] not in arguments.only]
        write(sorted([*kept, *rows], key=lambda row: list(OPTIONS).index(row["benchmark"])))


if __name__ == "__main__":
    main()
