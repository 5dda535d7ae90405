"""Resident memory of a run with a million transitions in a memory-mapped buffer.

    python benchmarks/memory.py
    python benchmarks/memory.py --env myoLegWalk --transitions 1000000

The buffer of stage 2 is filled with copies of one collected batch, since collecting a million
frames takes an hour. Then the run continues to collect in its worker and to learn. Memory is the
total of the learner and its workers: ``private`` is anonymous and shared memory, and ``file`` is
memory-mapped file pages, which the operating system may drop at any time.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
from pathlib import Path
from tempfile import TemporaryDirectory

from harness import line, recipe

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.training import run_alone


def resident_gigabytes() -> dict[str, float]:
    """Memory by kind of this process and its children (Linux), with shared pages split evenly."""
    processes = [os.getpid(), *(child.pid for child in multiprocessing.active_children())]
    total = {"private": 0, "file": 0}
    for process in processes:
        for row in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()[1:]:
            name, kilobytes = row.split()[:2]
            if name in ("Pss_Anon:", "Pss_Shmem:"):
                total["private"] += int(kilobytes)
            elif name == "Pss_File:":
                total["file"] += int(kilobytes)
    return {name: kilobytes / 1e6 for name, kilobytes in total.items()}


def measure(arguments: argparse.Namespace, folder: str) -> None:
    overrides = [
        f"env={arguments.env}",
        f"run_dir='{folder}'",
        "collector=process",
        f"learn.buffer_storage={arguments.storage}",
        f"learn.frames={arguments.transitions}",
    ]
    experiment = Experiment(recipe(*overrides))
    stage = experiment.method.stage()
    stage.restart_collection()
    stage.collect()
    rows = stage.newest(len(stage.buffer)).clone()
    copies = rows.expand(100, *rows.shape).reshape(-1)
    while len(stage.buffer) < arguments.transitions:
        stage.buffer.extend(copies)
    for _ in range(arguments.batches):
        stage.collect()
        run_alone(stage.learn())
    for name, gigabytes in resident_gigabytes().items():
        case = f"{arguments.env}/{arguments.storage}/{name}"
        line("memory", case, "GB", [gigabytes], transitions=len(stage.buffer))
    per_row = sum(value[0].numel() * value.element_size() for value in rows.values(True, True))
    line("memory", f"{arguments.env}/{arguments.storage}/transition", "kB", [per_row / 1e3])
    stage.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoLegWalk")
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--storage", default="memmap", choices=("memory", "memmap"))
    parser.add_argument("--batches", type=int, default=20, help="to go on for, when it is full")
    parser.add_argument("--folder", default=".", help="on a disk, for the buffer's files")
    arguments = parser.parse_args()
    quiet_torchrl()
    with TemporaryDirectory(dir=arguments.folder) as folder:
        measure(arguments, folder)


if __name__ == "__main__":
    main()
