"""Frames a second of training: ours (SAC, both stages of ETL), SBX and Stable-Baselines3.

    python benchmarks/end_to_end.py --peer none
    python benchmarks/end_to_end.py --envs myoLegWalk --seconds 10 --repeats 5

The same task, networks (two layers of 256, ReLU, no layer norm), batch (256) and updates a frame,
in processes that take turns on all cores for as many seconds each; while one is measured, the
others wait. Ours run compiled (``_eager``: not), in the layout that suits two cores: where updates
prevail the learner takes both and collects in between; where frames prevail a worker collects
while it learns. Stable-Baselines3 collects and learns in turn, as it is built to. So does SBX, once
with an update (``sbx``) and once with 16 in one compiled call (``sbx_scanned``) after the frames of
one environment, and once after a step of eight environments in processes (``sbx_8_envs``).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from functools import partial
from pathlib import Path

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
BY_DEFAULT = ("sac", "etl_learn", "etl_explore")
COLLECTORS = {1: "collector=single", 8: "collector=process"}  # by frames per update


def peer_options(frames_per_update: int) -> dict[str, list[str]]:
    """Arguments of ``peer_training.py`` by the name of a case."""
    sbx, stepwise = ["--library", "sbx"], str(max(1, 8 // frames_per_update))
    return {
        "sbx": sbx,
        "sbx_scanned": [*sbx, "--updates-at-once", "16"],
        "sbx_8_envs": [*sbx, "--updates-at-once", stepwise, "--envs", "8"],
        "stable_baselines3": ["--library", "stable_baselines3"],
    }


class Contender(Child):
    """A process that trains for as many seconds as it is told."""

    def await_ready(self) -> None:
        while self.answer() != "ready":
            pass

    def frames_per_second(self, seconds: float) -> float:
        return float(self.ask(seconds))


def commands(
    task: str, frames_per_update: int, methods: list[str], python: Path | None
) -> dict[str, list[str | Path]]:
    common = ["--frames-per-update", str(frames_per_update)]
    ours = [sys.executable, HERE / "training.py", "--env", task, *common]
    every = {}
    for name in methods:
        method, *overrides = OURS[name]
        every[name] = [*ours, "--method", method, COLLECTORS[frames_per_update], *overrides]
    if python is not None:
        peer = [python, HERE / "peer_training.py", "--env", resolve_task(task).env_id, *common]
        for name, options in peer_options(frames_per_update).items():
            every[name] = [*peer, *options]
    return every


def compare(
    task: str, frames_per_update: int, arguments: argparse.Namespace, python: Path | None
) -> None:
    contenders = {
        name: Contender(command, stderr=subprocess.DEVNULL)
        for name, command in commands(task, frames_per_update, arguments.methods, python).items()
    }
    for contender in contenders.values():
        contender.await_ready()
    cases = {
        name: partial(one.frames_per_second, arguments.seconds) for name, one in contenders.items()
    }
    values = interleave(cases, arguments.repeats)
    for name in cases:
        ours = name in OURS
        others = [other for other in cases if other not in OURS or other == "sac"] if ours else []
        line(
            "end_to_end",
            f"{task}/1:{frames_per_update}/{name}",
            "frames/s",
            values[name],
            peers={other: values[other] for other in others},
            seconds=arguments.seconds,
        )
    for contender in contenders.values():
        contender.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", nargs="+", default=("myoHandPenTwirl", "myoLegWalk"))
    parser.add_argument("--methods", nargs="*", choices=OURS, default=BY_DEFAULT)
    parser.add_argument(
        "--frames-per-update", nargs="+", type=int, default=(1, 8), choices=COLLECTORS
    )
    parser.add_argument("--peer", default=PYTHON, help="Python of the peers, or none")
    parser.add_argument("--seconds", type=float, default=6.0, help="of one measurement")
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    python = peer_python(arguments.peer)
    for task in arguments.envs:
        for frames_per_update in arguments.frames_per_update:
            compare(task, frames_per_update, arguments, python)


if __name__ == "__main__":
    main()
