"""Evaluation on fixed seeds that training never uses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_etl.analysis import Interval, interval, success_interval
from torchrl_etl.envs import episode_length, resolve_task

__all__ = [
    "EVALUATION_SEED",
    "Evaluation",
    "as_evaluated",
    "evaluate",
    "evaluate_task",
    "longest_episode",
]

EVALUATION_SEED = 10_000_000
"""Seed of the first evaluation episode; training seeds start at 2**30."""


class Evaluation(NamedTuple):
    """Episodes of one policy: undiscounted returns [E], lengths [E], solved steps [E] or None.

    ``time_limit`` is the length of a full episode. ``successes`` [E] tells which episodes count as
    solved, or is None.
    """

    returns: list[float]
    lengths: list[int]
    solved_steps: list[int] | None
    time_limit: int
    successes: list[bool] | None

    @property
    def mean_return(self) -> Interval:
        return interval(self.returns)

    @property
    def solved(self) -> Interval | None:
        """Share of episodes that count as solved.

        Walking tasks flag a step as "solved" while the speed is near the target, which includes
        falling forward; use :attr:`solved_time` there.
        """
        return None if self.successes is None else success_interval(self.successes)

    @property
    def solved_time(self) -> Interval | None:
        """Share of a full episode's steps that were solved."""
        if self.solved_steps is None:
            return None
        return interval([steps / self.time_limit for steps in self.solved_steps])

    def intervals(self) -> dict[str, Interval]:
        """The intervals that the environment defines, by name."""
        named = {"return": self.mean_return, "solved": self.solved, "solved_time": self.solved_time}
        return {name: value for name, value in named.items() if value is not None}

    def summary(self) -> dict[str, object]:
        """Intervals and the numbers of each episode, JSON-serializable."""
        intervals = {name: value._asdict() for name, value in self.intervals().items()}
        return {**intervals, "episodes": self._asdict(), "first_seed": EVALUATION_SEED}


def evaluate(
    policy: TensorDictModuleBase,
    env: EnvBase,
    *,
    episodes: int,
    max_steps: int = 1000,
    action_repeat: int = 1,
    solved_steps: int | None = None,
    seed: int = EVALUATION_SEED,
) -> Evaluation:
    """Run the deterministic policy for one episode per evaluation seed.

    The RNG state of training is preserved, so the number of evaluations does not affect it.

    Args:
        policy (TensorDictModuleBase): the policy.
        env (EnvBase): a single (unbatched) environment, transforms included.

    Keyword Args:
        episodes (int): number of episodes; episode i is seeded with ``seed + i``.
        max_steps (int): limit of an episode in simulator steps, the unit of the lengths.
        action_repeat (int): simulator steps per step of the environment.
        solved_steps (int, optional): number of solved steps that make an episode a success, such
            as :attr:`Task.solved_steps <torchrl_etl.envs.Task>`. Default: the last step must be.
        seed (int): first seed.
    """
    returns, lengths, solved, successes = [], [], [], []
    with as_evaluated(env):
        for episode in range(episodes):
            torch.manual_seed(seed + episode)
            env.set_seed(seed + episode)
            rollout = env.rollout(math.ceil(max_steps / action_repeat), policy)
            returns.append(rollout["next", "reward"].sum().item())
            lengths.append(min(max_steps, action_repeat * rollout.shape[-1]))
            if "solved" in rollout["next"].keys():
                flags = rollout["next", "solved"].flatten()
                solved.append(action_repeat * flags.sum().item())
                enough = solved_steps is not None and solved[-1] >= solved_steps
                successes.append(flags[-1].item() if solved_steps is None else enough)
    return Evaluation(returns, lengths, solved or None, max_steps, successes or None)


@contextmanager
def as_evaluated(env: EnvBase) -> Iterator[None]:
    """Context for deterministic actions without gradients; restores the RNG state on exit."""
    devices = [env.device] if env.device is not None and env.device.type == "cuda" else []
    with (
        torch.random.fork_rng(devices),
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
    ):
        yield


def evaluate_task(
    policy: TensorDictModuleBase, env: EnvBase, task: Mapping[str, Any], *, episodes: int
) -> Evaluation:
    """Evaluate a policy as every run does, with the task's episode length and success criterion.

    Args:
        policy (TensorDictModuleBase): the policy.
        env (EnvBase): the task's environment.
        task (mapping): arguments of :func:`~torchrl_etl.envs.make_env` that built it: ``name``,
            ``goal``, ``action_repeat`` and ``env_kwargs``.

    Keyword Args:
        episodes (int): number of episodes.

    Examples:
        >>> from torchrl_etl import zoo
        >>> policy, env = zoo.load("overactuated")
        >>> len(evaluate_task(policy, env, zoo.read_card("overactuated").task, episodes=2).returns)
        2
    """
    return evaluate(
        policy,
        env,
        episodes=episodes,
        max_steps=longest_episode(task),
        action_repeat=task.get("action_repeat", 1),
        solved_steps=resolve_task(task["name"], task.get("goal")).solved_steps,
    )


def longest_episode(task: Mapping[str, Any], *, unlimited: int = 1000) -> int:
    """Time limit of an episode in simulator steps; ``unlimited`` if the task has none.

    Examples:
        >>> longest_episode({"name": "overactuated"})
        25
        >>> longest_episode({"name": "overactuated", "env_kwargs": {"max_episode_steps": -1}})
        1000
    """
    given = (task.get("env_kwargs") or {}).get("max_episode_steps")
    steps = given or episode_length(task["name"], task.get("goal"))
    return unlimited if steps in (None, -1) else steps  # -1: Gymnasium's "no limit"
