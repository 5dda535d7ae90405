"""Frames per second of one and two workers by kind of collector; bytes per frame and push.

    python benchmarks/scaling.py            # JSON lines
    python benchmarks/scaling.py --write    # and docs/results/scaling.csv

Kinds and numbers of workers are interleaved within every repetition, so that other load affects
all of them. The learner pushes weights before each batch, as the stages do. CPU time is the total
of the learner and its descendants, and shows how much of the time is waiting.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import time
from functools import partial
from importlib.metadata import version
from pathlib import Path
from statistics import median

import torch
from harness import synergy_policy

from torchrl_etl.collectors import VectorCollector, make_batches
from torchrl_etl.collectors.remote import weights_of
from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.envs import make_env
from torchrl_etl.training.run_folder import facts

ROOT = Path(__file__).parent.parent
KINDS = ("process", "async", "ray", "distributed")
ORIGIN = ("commit", "machine", "torch", "torchrl", "mujoco", "myosuite")
KEPT = ("observation", "synergy", "action")
KEPT_NEXT = ("observation", "reward", "done", "terminated")


def cpu_seconds() -> tuple[float, float]:
    """CPU time so far of this process, and of all its live descendants (Linux)."""
    parents, seconds = {}, {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # the process has ended
                continue
            parents[int(folder.name)] = int(fields[1])
            ticks = int(fields[11]) + int(fields[12])
            seconds[int(folder.name)] = ticks / os.sysconf("SC_CLK_TCK")
    below, known = {os.getpid()}, 0
    while len(below) > known:
        known = len(below)
        below |= {process for process, parent in parents.items() if parent in below}
    return time.process_time(), sum(seconds[process] for process in below - {os.getpid()})


def measure(kind: str, workers: int, arguments: argparse.Namespace) -> dict[str, float]:
    """Start the workers and measure ``arguments.seconds`` of collection."""
    policy = synergy_policy(arguments.env, arguments.synergies)
    share = arguments.num_envs * arguments.steps
    batches = make_batches(
        kind,
        partial(make_env, arguments.env, num_envs=arguments.num_envs),
        policy,
        frames_per_batch=workers * share if kind == "process" else share,
        collector_class=VectorCollector,
        num_workers=workers,
        ahead=kind == "process",  # like the others: workers collect while the learner works
    )
    batches.restart(seed=0)
    try:
        for _ in range(2 * workers + 1):  # the first batches include the resets
            batch = batches.next()
        began, (learner, below), frames = time.perf_counter(), cpu_seconds(), 0
        while time.perf_counter() - began < arguments.seconds:
            batch = batches.next()
            frames += batch.numel()
        wall, (learner_after, below_after) = time.perf_counter() - began, cpu_seconds()
    finally:
        batches.close()
    kept = batch.select(*KEPT, *(("next", key) for key in KEPT_NEXT))
    return {
        "frames_per_second": frames / wall,
        "learner_cpu_us_per_frame": 1e6 * (learner_after - learner) / frames,
        "cpu_us_per_frame": 1e6 * (learner_after - learner + below_after - below) / frames,
        "sent_bytes_per_frame": batch.bytes() / batch.numel(),
        "kept_bytes_per_frame": kept.bytes() / batch.numel(),
        "bytes_per_push": weights_of(policy).bytes(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandPenTwirl")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--num-envs", type=int, default=8, help="simulators of a worker")
    parser.add_argument("--steps", type=int, default=50, help="steps of a simulator in a batch")
    parser.add_argument("--synergies", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=10.0, help="of one measurement")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="write docs/results/scaling.csv")
    arguments = parser.parse_args()
    quiet_torchrl()
    torch.set_num_threads(1)

    cases = [(kind, workers) for workers in arguments.workers for kind in arguments.kinds]
    runs: dict[tuple[str, int], list[dict[str, float]]] = {case: [] for case in cases}
    for repeat in range(arguments.repeats):
        for case in cases if repeat % 2 == 0 else reversed(cases):
            runs[case].append(measure(*case, arguments))

    origin = {key: value for key, value in facts().items() if key in ORIGIN}
    rows: list[dict[str, object]] = []
    for (kind, workers), measured in runs.items():
        row: dict[str, object] = {"env": arguments.env, "kind": kind, "workers": workers}
        row |= {"num_envs": arguments.num_envs, "steps": arguments.steps}
        row |= {"repeats": arguments.repeats, "seconds": arguments.seconds}
        for key in measured[0]:
            row[key] = round(median(run[key] for run in measured), 1)
        rates = [run["frames_per_second"] for run in measured]
        row |= {"slowest": round(min(rates), 1), "fastest": round(max(rates), 1)}
        rows.append(row | origin | {"ray": version("ray")})
        print(json.dumps(rows[-1]), flush=True)
    if arguments.write:
        with (ROOT / "docs" / "results" / "scaling.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
