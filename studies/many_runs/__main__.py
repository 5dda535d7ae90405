"""Many runs at once: what a GPU is good for with networks as small as these.

One process steps a simulator of each run and updates all of their networks side by side. A file
says which runs; their evaluations go to a table with the columns of the bench's.

    python -m studies.many_runs runs.json --out results.csv --device cuda --workers 14

    {"frames": 100000, "groups": [
      {"shape": {"updates": 2}, "runs": [
        {"task": "myoHandKeyTurn", "goal": "fixed", "seed": 100, "method": "sac_2_updates"},
        {"task": "myo2HandPose", "goal": "fixed", "seed": 100, "method": "sac_2_updates_3_steps",
         "settings": {"n_steps": 3}}]}]}

Runs of a group have one ``shape`` (see ``settings.Shape``) and ``settings`` of their own (see
``settings.Settings``). They may all name ``synergies``, a bundle that was explored before, whose
frames, ``charged``, count among theirs. The group may then name a ``residual``; with ``reuse`` its
runs learn from what was explored beside the bundles (``learn.reuse_exploration`` leaves it there,
as much for each), and with ``raw`` from that alone: they move muscles. ``goals.py`` writes such a
file.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_etl.analysis.sweep_results import COLUMNS
from torchrl_etl.collectors.seeds import training_seed
from torchrl_etl.envs import resolve_task
from torchrl_etl.training.run_folder import facts

from .group import Group
from .simulators import Simulators, Task, sizes

SOLVED_STEPS = 6  # of an episode that counts as solved, as MyoSuite counts
EPISODES = {"fixed": 1, "random": 5}  # of an evaluation; all that have a fixed goal are the same


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cpu", type=torch.device)
    parser.add_argument("--workers", type=int, default=1, help="processes that simulate")
    parser.add_argument("--every", type=int, default=5000, help="frames between evaluations")
    parser.add_argument(
        "--seconds", type=float, default=np.inf, help="after which no more is learned"
    )
    parser.add_argument("--commit", help="of the working tree, where git tells of another")
    arguments = parser.parse_args()
    ManyRuns(json.loads(arguments.runs.read_text()), arguments).learn()


class ManyRuns:
    """All runs of a file."""

    def __init__(self, described: dict[str, Any], arguments: argparse.Namespace) -> None:
        self.arguments, self.frames = arguments, described["frames"]
        self.runs = [run for group in described["groups"] for run in group["runs"]]
        tasks = [Task(run["task"], run["goal"]) for run in self.runs]
        known = {task: sizes(task) for task in dict.fromkeys(tasks)}
        observations = [known[task][0] for task in tasks]
        (actions,) = {actions for _, actions in known.values()}
        self.limits = np.array([resolve_task(*task).episode_steps for task in tasks])
        self.episodes = np.array([EPISODES[task.goal] for task in tasks])
        # Processes are forked before CUDA starts.
        self.simulators = Simulators(
            tasks,
            [training_seed(2 * run["seed"] + 1, 0) for run in self.runs],
            self.episodes,
            (max(observations), actions),
            arguments.workers,
        )
        torch.set_float32_matmul_precision("high")
        self.groups, first = [], 0
        for group in described["groups"]:
            rows = slice(first, first + len(group["runs"]))
            sees, first = observations[rows], rows.stop
            self.groups.append(Group(group, rows, sees, actions, self.frames, arguments.device))
        self.facts = self.known_facts()
        self.rows: list[dict[str, Any]] = []
        self.started = time.monotonic()

    def known_facts(self) -> dict[str, str]:
        """Commit, machine and versions, as the table has them."""
        known = facts()
        commit, machine = known.pop("commit"), known.pop("machine")
        machine += f", {len(self.runs)} runs at once"
        if self.arguments.device.type == "cuda":
            machine += f" on {torch.cuda.get_device_name()}"
        commit = self.arguments.commit or commit
        return {"commit": commit, "machine": machine, "versions": json.dumps(known)}

    def learn(self) -> None:
        simulators = self.simulators
        for group in self.groups:
            group.show(simulators)
        self.evaluate(0)
        pauses = {*range(0, self.frames, self.arguments.every), *map(self.own_frames, self.runs)}
        last = max(pauses)
        for frames in range(1, last + 1):
            self.act()
            simulators.send("step")
            for group in self.groups:
                if frames > group.shape.learning_starts:
                    group.update()
            simulators.receive()
            for group in self.groups:
                group.store(simulators)
            if frames in pauses:
                self.evaluate(frames)
                if time.monotonic() - self.started > self.arguments.seconds:
                    break
        self.save("finished" if frames == last else "stopped")

    def own_frames(self, run: dict[str, Any]) -> int:
        """What exploration leaves of the budget."""
        return self.frames - run.get("charged", 0)

    def act(self, *, trained: bool = False) -> None:
        for group in self.groups:
            group.act(trained=trained)
        for group in self.groups:
            self.simulators.action[group.rows] = group.actions()

    def evaluate(self, frames: int) -> None:
        """Episodes of the averaged actors, as :func:`torchrl_etl.training.evaluate` has them."""
        simulators = self.simulators
        kept = [array.copy() for array in (simulators.observation, simulators.done)]
        returns = np.zeros((len(self.runs), self.episodes.max()))
        solved = np.zeros_like(returns)
        for episode in range(self.episodes.max()):
            simulators.send("reset", episode)
            simulators.receive()
            while not simulators.done.all():
                going = ~simulators.done
                for group in self.groups:
                    group.show(simulators)
                self.act(trained=True)
                simulators.send("try")
                simulators.receive()
                returns[:, episode] += going * simulators.reward
                solved[:, episode] += going * simulators.solved
        simulators.observation[:], simulators.done[:] = kept
        for group in self.groups:
            group.show(simulators)
        self.report(frames, returns, solved)
        self.save("stopped")

    def report(self, frames: int, returns: np.ndarray, solved: np.ndarray) -> None:
        seconds = round(time.monotonic() - self.started, 1)
        logged = [row for group in self.groups for row in group.learner.logged.tolist()]
        for i, (run, (entropy, alpha, value)) in enumerate(zip(self.runs, logged, strict=True)):
            if frames > self.own_frames(run):
                continue
            tried = slice(self.episodes[i])
            self.rows.append(
                {
                    **{key: run[key] for key in ("task", "goal", "method", "seed")},
                    "frames": frames + run.get("charged", 0),
                    "return": returns[i, tried].mean(),
                    "solved": (solved[i, tried] >= SOLVED_STEPS).mean(),
                    "solved_time": (solved[i, tried] / self.limits[i]).mean(),
                    "episodes": self.episodes[i],
                    "wall_seconds": seconds,
                    **{"entropy": entropy, "alpha": alpha, "value": value},
                }
            )
        print(f"{frames} frames, {seconds} s: {returns[:, 0].round().tolist()}", flush=True)

    def save(self, status: str) -> None:
        """Write the whole table anew; until the last frame it says that runs were stopped."""
        own = self.facts | {"status": status}
        part = self.arguments.out.with_suffix(".part")
        with part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*COLUMNS, "entropy", "alpha", "value"])
            writer.writeheader()
            writer.writerows(row | own for row in self.rows)
        part.replace(self.arguments.out)


if __name__ == "__main__":
    main()
