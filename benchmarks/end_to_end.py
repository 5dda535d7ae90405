"""Frames a second of training: ETL's stage 2 and stage 1, our plain SAC, Stable-Baselines3's SAC.

    python benchmarks/end_to_end.py
    python benchmarks/end_to_end.py --peer .venv-peers/bin/python --repeats 5

The same task, networks (two layers of 256, no layer norm), batch (256) and updates a frame, in
processes that take turns: while one is measured, the others wait. Ours run compiled (``_eager``:
not), in the layout that suits two cores: where updates prevail the learner takes both cores and
collects in between; where frames prevail a worker collects while it learns. Stable-Baselines3
collects and learns in turn, on both cores, as it is built to.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from functools import partial
from pathlib import Path

from harness import Child, interleave, line

from torchrl_etl.envs.tasks import resolve_task

HERE = Path(__file__).parent
OURS = {
    "etl_learn": ("etl_learn", "compile=true"),
    "etl_learn_eager": ("etl_learn", "compile=false"),
    "etl_explore": ("etl_explore", "compile=true"),
    "sac": ("sac", "compile=true"),
}
# By frames per update: the frames of one measurement, and where ours collect.
FRAMES = {1: 256, 16: 2048}
COLLECTORS = {1: "collector=single", 16: "collector=process"}


class Contender(Child):
    """A process that trains for as many frames as it is told."""

    def await_ready(self) -> None:
        while self.answer() != "ready":
            pass

    def frames_per_second(self, frames: int) -> float:
        return frames / float(self.ask(frames))


def compare(task: str, frames_per_update: int, arguments: argparse.Namespace) -> None:
    common = ["--frames-per-update", str(frames_per_update)]
    ours = [sys.executable, str(HERE / "training.py"), "--env", task, *common]
    commands = {}
    for name in arguments.methods:
        method, *overrides = OURS[name]
        collector = COLLECTORS[frames_per_update]
        commands[name] = [*ours, "--method", method, collector, *overrides]
    if arguments.peer:
        peer = [arguments.peer, str(HERE / "peer_sb3_training.py")]
        commands["stable_baselines3"] = [*peer, "--env", resolve_task(task).env_id, *common]
    contenders = {
        name: Contender(command, stderr=subprocess.DEVNULL) for name, command in commands.items()
    }
    for contender in contenders.values():
        contender.await_ready()
    frames = FRAMES[frames_per_update]
    cases = {name: partial(one.frames_per_second, frames) for name, one in contenders.items()}
    values = interleave(cases, arguments.repeats)
    for name in cases:
        for peer in ("stable_baselines3", "sac"):
            if peer in values and peer != name:
                line(
                    "end_to_end",
                    f"{task}/1:{frames_per_update}/{name}",
                    "frames/s",
                    values[name],
                    peer=peer,
                    peer_values=values[peer],
                )
    for contender in contenders.values():
        contender.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandPenTwirl")
    parser.add_argument("--methods", nargs="*", choices=OURS, default=list(OURS))
    parser.add_argument("--frames-per-update", nargs="+", type=int, default=(1, 16), choices=FRAMES)
    parser.add_argument("--peer", help="Python with stable-baselines3; see `make bench`")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    for frames_per_update in arguments.frames_per_update:
        compare(arguments.env, frames_per_update, arguments)


if __name__ == "__main__":
    main()
