"""Runs the benchmarks one after another and puts their figures into docs/performance.md.

python benchmarks/bench.py                       # all, as JSON lines
python benchmarks/bench.py --only collection     # one of them
python benchmarks/bench.py --write               # and the table in docs, and the CSV beside it
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "performance.md"
CSV = HERE.parent / "docs" / "results" / "performance.csv"
NAMES = ("collection", "update", "end_to_end", "transforms", "memory")
OPTIONS = {"update": ["--compile", "--repeats", "5"]}
BEGIN, END = "<!-- table: make bench -->\n", "<!-- end of table -->\n"


def run(name: str, peer: str | None) -> list[dict[str, Any]]:
    command = [sys.executable, str(HERE / f"{name}.py"), *OPTIONS.get(name, [])]
    if peer and name == "end_to_end":
        command += ["--peer", peer]
    rows = []
    # Each benchmark decides on its own threads.
    env = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) as process:
        for text in process.stdout:
            if text.startswith("{"):
                print(text, end="", flush=True)
                rows.append(json.loads(text))
    if process.returncode:
        raise SystemExit(f"Error: {name}.py ended with {process.returncode}.")
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| benchmark | case | median | ± | unit | ratio | to |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        figures = f"{row['median']:,.4g} | {row['spread']:.2g} | {row['unit']}"
        ratio = f"{row['ratio']:.2f} ± {row['ratio_spread']:.2f}" if "ratio" in row else ""
        peer = row.get("peer", "")
        if peer and row["case"].rsplit("/", 1)[-1] == peer:
            ratio, peer = "", ""
        lines.append(f"| {row['benchmark']} | `{row['case']}` | {figures} | {ratio} | {peer} |")
    return "\n".join(lines) + "\n"


def write(rows: list[dict[str, Any]]) -> None:
    with CSV.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows(rows)
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    PAGE.write_text(before + BEGIN + table(rows) + END + rest.split(END)[1], encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--peer", help="Python with stable-baselines3")
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.only:
        rows += run(name, arguments.peer)
    if arguments.write:
        kept = []
        if CSV.exists():  # what was not run now stays
            with CSV.open(encoding="utf-8") as file:
                kept = [
                    row for row in csv.DictReader(file) if row["benchmark"] not in arguments.only
                ]
        write(
            sorted([*map(as_numbers, kept), *rows], key=lambda row: NAMES.index(row["benchmark"]))
        )


def as_numbers(row: dict[str, str]) -> dict[str, Any]:
    numbers = ("median", "spread", "ratio", "ratio_spread")
    return {k: float(v) if k in numbers else v for k, v in row.items() if v != ""}


if __name__ == "__main__":
    main()
