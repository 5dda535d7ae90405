"""Training frames per second of ours (SAC, both stages of ETL), SBX and Stable-Baselines3.

    python benchmarks/end_to_end.py --peer none
    python benchmarks/end_to_end.py --envs myoLegWalk --seconds 10 --repeats 5

All use the same task, networks (two layers of 256, ReLU, no layer norm), batch size (256) and
replay ratio. Their processes take turns on all cores, for the same time each; the others wait.
Ours are compiled, except for ``_eager``, with the allocation of cores chosen by ``collector=auto``.
Stable-Baselines3 alternates between collection and updates. So does SBX in three cases: one update
(``sbx``) or 16 in one compiled call (``sbx_scanned``) after the frames of one environment, and
updates after a step of eight environments in processes (``sbx_8_envs``).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

from harness import Child, interleave, line
from peers import PYTHON, peer_python

from torchrl_etl.envs.tasks import resolve_task

HERE = Path(__file__).parent
OURS = {
    "sac": ("sac", "compile=true"),
    "etl_learn": ("etl_learn", "compile=true"),
    "etl_explore": ("etl_explore", "compile=true"),
    "etl_learn_eager": ("etl_learn", "compile=false"),
}
FRAMES_PER_UPDATE = (1, 8)
BY_DEFAULT = ("sac", "etl_learn", "etl_explore")
PEERS = {  # library, number of environments
    "sbx": ("sbx", 1),
    "sbx_8_envs": ("sbx", 8),
    "stable_baselines3": ("stable_baselines3", 1),
}


def peer_cases(frames_per_update: int) -> dict[str, tuple[str, int]]:
    """For each case, the name in ``PEERS`` and the number of updates at a time."""
    return {
        "sbx": ("sbx", 1),
        "sbx_scanned": ("sbx", 16),
        "sbx_8_envs": ("sbx_8_envs", max(1, 8 // frames_per_update)),
        "stable_baselines3": ("stable_baselines3", 1),
    }


class Contender(Child):
    """A process that trains for a requested number of seconds."""

    def await_ready(self) -> dict[str, Any]:
        """Information before ``ready``: versions of a peer, or our allocation of cores."""
        lines = list(iter(self.answer, "ready"))
        return json.loads(next((line for line in lines if line.startswith("{")), "{}"))

    def frames_per_second(self, *order: float) -> float:
        return float(self.ask(" ".join(map(str, order))))


def start_ours(
    task: str, frames_per_update: int, methods: list[str]
) -> dict[str, tuple[Contender, dict[str, Any]]]:
    """Our contenders, with their allocation of cores."""
    script = [sys.executable, HERE / "training.py", "--env", task]
    script += ["--frames-per-update", str(frames_per_update), "--method"]
    ours = {}
    for name in methods:
        method, *overrides = OURS[name]
        command = [*script, method, "collector=auto", *overrides]
        contender = Contender(command, stderr=subprocess.DEVNULL)
        ours[name] = contender, contender.await_ready()  # before the next one's own benchmark
    return ours


def start_peers(task: str, python: Path | None) -> dict[str, Contender]:
    peers = {}
    for name, (library, envs) in PEERS.items() if python else ():
        command = [python, HERE / "peer_training.py", "--env", resolve_task(task).env_id]
        command += ["--library", library, "--envs", str(envs)]
        peers[name] = Contender(command, stderr=subprocess.DEVNULL)
    return peers


def compare(
    task: str,
    frames_per_update: int,
    peers: dict[str, Contender],
    arguments: argparse.Namespace,
    versions: dict[str, str],
) -> None:
    ours = start_ours(task, frames_per_update, arguments.methods)
    seconds = arguments.seconds
    cases = {name: partial(each.frames_per_second, seconds) for name, (each, _) in ours.items()}
    for name, (peer, at_once) in peer_cases(frames_per_update).items() if peers else ():
        order = seconds, frames_per_update, at_once
        cases[name] = partial(peers[peer].frames_per_second, *order)
    values = interleave(cases, arguments.repeats)
    for name in cases:
        others = [other for other in cases if other == "sac" or other not in ours]
        line(
            "end_to_end",
            f"{task}/1:{frames_per_update}/{name}",
            "frames/s",
            values[name],
            peers={other: values[other] for other in others if name in ours},
            seconds=seconds,
            **(ours[name][1] if name in ours else {}),
            **({"peer_versions": versions} if versions else {}),
        )
    for contender, _ in ours.values():
        contender.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", nargs="+", default=("myoHandPenTwirl", "myoLegWalk"))
    parser.add_argument("--methods", nargs="*", choices=OURS, default=BY_DEFAULT)
    parser.add_argument("--frames-per-update", nargs="+", type=int, default=FRAMES_PER_UPDATE)
    parser.add_argument("--peer", default=PYTHON, help="Python of the peers, or none")
    parser.add_argument("--seconds", type=float, default=5.0, help="of one measurement")
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    python = peer_python(arguments.peer)
    for task in arguments.envs:
        peers, versions = start_peers(task, python), {}
        for peer in peers.values():
            versions |= peer.await_ready()
        for frames_per_update in arguments.frames_per_update:
            compare(task, frames_per_update, peers, arguments, versions)
        for peer in peers.values():
            peer.close()


if __name__ == "__main__":
    main()
