"""One simulator for every run, stepped by processes that share their arrays with the learner."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from torchrl_etl.envs import make_env
from torchrl_etl.envs.tasks import Goal
from torchrl_etl.training.evaluation import EVALUATION_SEED

__all__ = ["Simulators", "Task", "sizes"]


class Task(NamedTuple):
    """What a run learns."""

    name: str
    goal: Goal


def sizes(task: Task) -> tuple[int, int]:
    """Entries of an observation and of an action, which must lie in [-1, 1]."""
    env = make_env(task.name, goal=task.goal)
    space = env.full_action_spec_unbatched["action"].space
    if not ((space.low == -1).all() and (space.high == 1).all()):
        raise ValueError(f"{task.name} has other actions than [-1, 1], which is all that is known.")
    found = env.observation_spec["observation"].shape[-1], space.low.shape[-1]
    env.close()
    return found


class Simulators:
    """Two simulators a run: one to learn from, one to evaluate on.

    Attributes:
        action [N, n]: what the next step takes.
        observation [N, O]: what an agent sees now; entries that a task lacks are zero.
        following [N, O]: what it saw after the last step, before an episode began anew.
        reward [N], terminated [N], done [N], solved [N]: of the last step.
    """

    def __init__(
        self,
        tasks: Sequence[Task],
        seeds: Sequence[int],
        episodes: Sequence[int],
        shape: tuple[int, int],
        workers: int,
    ) -> None:
        count, (observations, actions) = len(tasks), shape
        self.episodes = episodes
        context = multiprocessing.get_context("fork")
        self._raw = []

        def shared(*shape: int, dtype: type = np.float32) -> np.ndarray:
            raw = context.RawArray("b", int(np.prod(shape)) * np.dtype(dtype).itemsize)
            self._raw.append(raw)
            return np.frombuffer(raw, dtype).reshape(shape)

        self.action = shared(count, actions)
        self.observation, self.following = shared(count, observations), shared(count, observations)
        self.reward = shared(count, dtype=np.float64)
        self.terminated, self.done, self.solved = (shared(count, dtype=np.bool_) for _ in range(3))
        self._ends: list[Connection] = []
        for first in range(workers):
            here, there = context.Pipe()
            mine = range(first, count, workers)
            arguments = ([(i, tasks[i], seeds[i]) for i in mine], there, self)
            context.Process(target=_work, args=arguments, daemon=True).start()
            self._ends.append(here)
        self.receive()  # all are built

    def send(self, command: str, number: int = 0) -> None:
        """``step``; or, of those to evaluate on, ``reset`` for an episode and ``try`` a step."""
        for end in self._ends:
            end.send((command, number))

    def receive(self) -> None:
        """Wait for what was sent last."""
        for end in self._ends:
            if (fault := end.recv()) is not None:
                raise RuntimeError(f"a simulator failed: {fault}")


def _work(mine: list[tuple[int, Task, int]], end: Connection, arrays: Simulators) -> None:
    try:
        pairs = []
        for i, task, seed in mine:
            learning, evaluating = (make_env(task.name, goal=task.goal)._env for _ in range(2))
            parts, _ = learning.reset(seed=seed)
            arrays.observation[i, : parts["observation"].size] = parts["observation"]
            pairs.append((i, learning, evaluating))
        end.send(None)
        for command, number in _commands(end):
            for i, learning, evaluating in pairs:
                if command == "reset":
                    arrays.done[i] = number >= arrays.episodes[i]
                    if arrays.done[i]:
                        continue
                    evaluating.reset(seed=EVALUATION_SEED + number)
                    parts, _ = evaluating.reset()  # as an environment of TorchRL, seeded, does
                    arrays.observation[i, : parts["observation"].size] = parts["observation"]
                elif command == "step":
                    if _step(learning, i, arrays):
                        parts, _ = learning.reset()
                        arrays.observation[i, : parts["observation"].size] = parts["observation"]
                elif not arrays.done[i]:
                    _step(evaluating, i, arrays)
            end.send(None)
    except Exception as fault:  # the learner's process says so and ends
        end.send(repr(fault))


def _commands(end: Connection) -> Iterator[tuple[str, int]]:
    while True:
        try:
            yield end.recv()
        except EOFError:
            return


def _step(env, i: int, arrays: Simulators) -> bool:
    parts, reward, terminated, truncated, _ = env.step(arrays.action[i].copy())
    size = parts["observation"].size
    arrays.following[i, :size] = arrays.observation[i, :size] = parts["observation"]
    arrays.reward[i], arrays.terminated[i] = reward, terminated
    arrays.done[i] = terminated or truncated
    arrays.solved[i] = bool(parts["solved"][0])
    return bool(arrays.done[i])
