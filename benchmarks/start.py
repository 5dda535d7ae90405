"""Seconds from the command to the first update, eager and compiled, with SBX for comparison.

    python benchmarks/start.py --peer none

Starts plain SAC on one task, as in ``end_to_end.py``, in a new process each time. This includes
loading Python and its libraries, building the simulators, collecting 500 frames, compiling the
update and making it once. ``compiled`` begins with an empty compilation cache. ``compiled_again``
reuses that of the previous run, like every run after the first one on a machine.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from end_to_end import HERE, Contender
from harness import line
from peers import PYTHON, peer_python

from torchrl_etl.envs.tasks import resolve_task


def start(
    command: list[str | Path], order: str | None = None, **environment: str
) -> tuple[float, dict[str, Any]]:
    """Seconds until the first update, triggered by ``order`` for a peer, and the child's output."""
    begun = time.perf_counter()
    env = {**os.environ, **environment}
    contender = Contender(command, stderr=subprocess.DEVNULL, env=env)
    said = contender.await_ready()
    if order is not None:
        contender.ask(order)
    taken = time.perf_counter() - begun
    contender.close()
    return taken, said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandPenTwirl")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--peer", default=PYTHON, help="Python of the peers, or none")
    arguments = parser.parse_args()
    python = peer_python(arguments.peer)

    ours = [sys.executable, HERE / "training.py", "--env", arguments.env, "--method", "sac"]
    ours += ["--frames-per-update", "1"]
    compiled = partial(start, [*ours, "compile=true"])
    cases = {"eager": partial(start, [*ours, "compile=false"])}
    cases |= {"compiled": compiled, "compiled_again": compiled}
    if python:
        task = resolve_task(arguments.env).env_id
        command = [python, HERE / "peer_training.py", "--env", task, "--library", "sbx"]
        cases["sbx"] = partial(start, command, "0.3 1 1")
    values: dict[str, list[float]] = {name: [] for name in cases}
    more: dict[str, Any] = {}
    for _ in range(arguments.repeats):
        with TemporaryDirectory() as cache:  # filled by the first compilation, used by the second
            for name, case in cases.items():
                taken, said = case(TORCHINDUCTOR_CACHE_DIR=cache)
                values[name].append(taken)
                if name == "sbx":
                    more = {"peer_versions": said}
    for name, each in values.items():
        others = {"sbx": values["sbx"]} if python and name.startswith("compiled") else {}
        line("start", f"{arguments.env}/{name}", "s", each, peers=others, **more)


if __name__ == "__main__":
    main()
