"""Many runs at once: what a GPU is good for with networks as small as these.

One process steps a simulator of each of N runs and updates all of their networks in one CUDA graph.
A file says which runs; evaluations go to a table with the columns of the bench's.

    python -m benchmarks.many_runs runs.json --out results.csv --device cuda --workers 7

    {"shape": {"frames": 100000},
     "runs": [{"task": "myoHandKeyTurn", "goal": "fixed", "seed": 100, "method": "sac_3_steps",
               "settings": {"n_steps": 3}}]}

A run may name ``synergies``, a bundle that was explored before; then all must. ``charged`` frames
of exploration are added to its own.
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

from torchrl_etl.analysis.bench_results import COLUMNS
from torchrl_etl.collectors.seeds import training_seed
from torchrl_etl.envs import resolve_task
from torchrl_etl.modules.bundle import load_bundle
from torchrl_etl.training.evaluation import SOLVED_STEPS
from torchrl_etl.training.run_folder import facts

from .learner import Learner, Settings, Shape
from .returns import ReturnScales
from .simulators import Simulators, Task, sizes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--every", type=int, default=5000, help="frames between evaluations")
    parser.add_argument("--commit", help="of the working tree, where git does not tell")
    parser.add_argument("--seconds", type=float, default=1e9, help="stop before the budget is used")
    arguments = parser.parse_args()
    described = json.loads(arguments.runs.read_text())
    ManyRuns(described, arguments).learn()


class ManyRuns:
    def __init__(self, described: dict[str, Any], arguments: argparse.Namespace) -> None:
        self.arguments, self.runs = arguments, described["runs"]
        self.shape = Shape(**described.get("shape", {}))
        tasks = [Task(run["task"], run["goal"]) for run in self.runs]
        known = {task: sizes(task) for task in dict.fromkeys(tasks)}
        observations = [known[task][0] for task in tasks]
        (actions,) = {actions for _, actions in known.values()}
        self.seeds = [run["seed"] for run in self.runs]
        self.episodes = np.array([5 if task.goal == "random" else 1 for task in tasks])
        # Processes are forked before CUDA starts.
        self.simulators = Simulators(
            tasks,
            [training_seed(2 * seed + 1, 0) for seed in self.seeds],
            self.episodes,
            (max(observations), actions),
            arguments.workers,
        )
        self.limits = np.array([resolve_task(*task).episode_steps for task in tasks])
        self.settings = [Settings(**run.get("settings", {})) for run in self.runs]
        decoders = None
        if "synergies" in self.runs[0]:
            decoders = [
                load_bundle(run["synergies"], residual=run.get("residual", 0.5))[0]
                for run in self.runs
            ]
        torch.set_float32_matmul_precision("high")
        self.learner = Learner(
            self.shape,
            self.settings,
            [2 * seed + 1 for seed in self.seeds],
            observations,
            actions,
            decoders,
            torch.device(arguments.device),
        )
        torch.manual_seed(self.seeds[0])
        gammas = np.array([s.gamma for s in self.settings])
        self.scales = ReturnScales(gammas, self.shape.bound)
        # Through pinned memory, and waiting asleep: simulators need the cores.
        self.staged = torch.zeros(self.learner.told.shape)
        self.moved = torch.zeros(self.learner.muscles.shape)
        self.event = None
        if arguments.device == "cuda":
            self.staged, self.moved = self.staged.pin_memory(), self.moved.pin_memory()
            self.event = torch.cuda.Event(blocking=True)
        self.rows: list[dict[str, Any]] = []
        self.waited = {"learner": 0.0, "simulators": 0.0}
        self.started = time.monotonic()

    def learn(self) -> None:
        learner, simulators, width = self.learner, self.simulators, self.learner.width
        staged = self.staged.numpy()
        staged[:, 2:4] = 1.0
        staged[:, -width:] = simulators.observation
        learner.told.copy_(self.staged, non_blocking=True)
        self.evaluate(0)
        for frames in range(1, self.shape.frames + 1):
            learner.act()
            begun = time.monotonic()
            simulators.action[:] = self.muscles()
            self.waited["learner"] += time.monotonic() - begun
            simulators.send("step")
            if frames > self.shape.learning_starts:
                for _ in range(self.shape.updates):
                    learner.update()
            begun = time.monotonic()
            simulators.receive()
            self.waited["simulators"] += time.monotonic() - begun
            self.scales.see(simulators.reward, simulators.done)
            staged[:, 0], staged[:, 1] = simulators.reward, simulators.terminated
            staged[:, 2], staged[:, 3] = simulators.done, self.scales.scale()
            staged[:, 4 : 4 + width] = simulators.following
            staged[:, -width:] = simulators.observation
            learner.told.copy_(self.staged, non_blocking=True)
            learner.store()
            if frames % self.arguments.every == 0 or frames == self.shape.frames:
                self.evaluate(frames)
                if time.monotonic() - self.started > self.arguments.seconds:
                    break
        self.save("finished" if frames == self.shape.frames else "stopped")

    def muscles(self) -> np.ndarray:
        self.moved.copy_(self.learner.muscles, non_blocking=True)
        if self.event is not None:
            self.event.record()
            self.event.synchronize()
        return self.moved.numpy()

    def evaluate(self, frames: int) -> None:
        """Episodes of the averaged actor, as ``torchrl_etl.training.evaluate`` has them."""
        learner, simulators, width = self.learner, self.simulators, self.learner.width
        kept = [array.copy() for array in (simulators.observation, simulators.done)]
        told = learner.told.clone()
        chosen = learner.muscles.clone()
        returns = np.zeros((len(self.runs), self.episodes.max()))
        solved = np.zeros_like(returns)
        for episode in range(self.episodes.max()):
            simulators.send("reset", episode)
            simulators.receive()
            for _ in range(self.limits.max()):
                self.staged[:, -width:] = torch.from_numpy(simulators.observation)
                learner.told.copy_(self.staged, non_blocking=True)
                learner.try_out()
                going = ~simulators.done
                simulators.action[:] = self.muscles()
                simulators.send("try")
                simulators.receive()
                returns[:, episode] += going * simulators.reward
                solved[:, episode] += going * simulators.solved
                if simulators.done.all():
                    break
        simulators.observation[:], simulators.done[:] = kept
        learner.told.copy_(told)
        learner.muscles.copy_(chosen)
        now = round(time.monotonic() - self.started, 1)
        logged = learner.logged.tolist()
        for i, run in enumerate(self.runs):
            episodes = range(self.episodes[i])
            self.rows.append(
                {
                    **{key: run[key] for key in ("task", "goal", "method", "seed")},
                    "frames": frames + run.get("charged", 0),
                    "return": returns[i, episodes].mean(),
                    "solved": (solved[i, episodes] > SOLVED_STEPS).mean(),
                    "solved_time": (solved[i, episodes] / self.limits[i]).mean(),
                    "episodes": len(episodes),
                    "wall_seconds": now,
                    "entropy": logged[i][0],
                    "alpha": logged[i][1],
                    "value": logged[i][2],
                }
            )
        waited = ", ".join(f"{seconds:.1f} s for {who}" for who, seconds in self.waited.items())
        returned = returns[:, 0].round().astype(int).tolist()
        print(f"{frames} frames, {now} s (waited {waited}): {returned}", flush=True)
        self.save("stopped")

    def save(self, status: str) -> None:
        known = facts()
        own = {"commit": known.pop("commit") or self.arguments.commit}
        own |= {"machine": known.pop("machine")}
        if torch.cuda.is_available():
            own["machine"] += f", {torch.cuda.get_device_name()}, {len(self.runs)} runs at once"
        own |= {"versions": json.dumps(known), "status": status}
        temporary = self.arguments.out.with_suffix(".part")
        with temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*COLUMNS, "entropy", "alpha", "value"])
            writer.writeheader()
            writer.writerows(row | own for row in self.rows)
        temporary.replace(self.arguments.out)


if __name__ == "__main__":
    main()
