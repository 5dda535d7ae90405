"""Checks that a task's action space admits synergies."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformAction

__all__ = ["check_action_space", "flat_action"]

_LARGEST_BOUND = 1e6
"""Larger bounds count as unbounded: MuJoCo and DMControl write 1e10 for a motor without limits."""


def flat_action(env: gym.Env) -> gym.Env:
    """The environment with its action flattened to one array of actuators."""
    box = env.action_space
    flat = spaces.Box(box.low.ravel(), box.high.ravel(), dtype=box.dtype.type)
    return TransformAction(env, lambda action: np.reshape(action, box.shape), flat)


def check_action_space(space: spaces.Space, task: str) -> None:
    """Reject action spaces, of any shape, in which no synergy can be learned.

    Raises:
        ValueError: unless the space is a floating-point ``Box`` with low < high for every
            actuator, and bounds of at most 1e6 in magnitude.
    """
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise ValueError(
            f"{task} has the action space {space}; synergies need continuous actuators, so choose "
            "a task with a Box of real numbers as action space."
        )
    low, high = space.low.ravel(), space.high.ravel()
    if low.size == 0:
        raise ValueError(f"{task} has no actuators; choose a task with at least one.")
    largest = np.maximum(np.abs(low), np.abs(high))
    _refuse(
        ~(largest <= _LARGEST_BOUND),
        task,
        "no bounds",
        low,
        high,
        "policies act between finite bounds, so register the task with a wrapper that declares "
        "some, such as gymnasium.wrappers.TransformAction with a Box from -1 to 1",
    )
    _refuse(
        ~(low < high),
        task,
        "no room between its bounds",
        low,
        high,
        "leave it out of the action with a wrapper, or widen its bounds",
    )


def _refuse(
    bad: np.ndarray, task: str, fault: str, low: np.ndarray, high: np.ndarray, cure: str
) -> None:
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise ValueError(
            f"{task}: actuator {first} of {bad.size} has {fault} "
            f"([{low[first]:g}, {high[first]:g}]); {cure}."
        )
