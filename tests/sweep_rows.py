"""Rows of results.csv, and runs, files and sweeps made of them."""

from __future__ import annotations

import csv
from pathlib import Path

from torchrl_etl.analysis.sweep_results import COLUMNS, read_sweep

FEW = 50  # bootstrap resamples


def row(**cells):
    return {
        "task": "myoHandKeyTurn",
        "goal": "fixed",
        "method": "sac",
        "seed": 0,
        "frames": 0,
        "return": 0.0,
        "solved": "",
        "solved_time": "",
        "episodes": 10,
        "wall_seconds": 3600,
        "commit": "abc1234",
        "versions": '{"torch": "2.13.0"}',
        "machine": "Linux x86_64, 2 cores",
        "settings": "learn.n_steps=3",
        "status": "finished",
    } | cells


def run(returns, frames=None, **cells):
    frames = frames or [50_000 * i for i in range(len(returns))]
    pairs = zip(frames, returns, strict=True)
    return [row(frames=f, **{"return": value}, **cells) for f, value in pairs]


def write(folder: Path, rows, columns=COLUMNS) -> Path:
    folder.mkdir(exist_ok=True)
    with (folder / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return folder


def sweep(folder, *runs):
    return read_sweep(write(folder, [one for rows in runs for one in rows]))
