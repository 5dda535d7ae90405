"""An environment's muscle state, and how its actions excite the muscles."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import gymnasium as gym
import numpy as np
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etl.envs.simulator import mujoco_state, simulator

__all__ = ["muscle_state", "sends_sigmoid"]

Array = Tensor | np.ndarray


def muscle_state(env: EnvBase | gym.Env, asked_by: str) -> tuple[Any, Any]:
    """MuJoCo's model and data of a body whose actuators are all muscles, one per action entry.

    Raises:
        ValueError: for any other environment; the message begins with ``asked_by``.
    """
    inner, found = simulator(env), "none"
    with suppress(ValueError):
        model, data = mujoco_state(inner)
        import mujoco  # installed, since the model exists

        muscles = int((model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE).sum())
        size = math.prod(inner.action_space.shape)
        if muscles == model.nu == size:
            return model, data
        found = f"{model.nu} actuators, {muscles} of them muscles, and actions with {size} entries"
    raise ValueError(
        f"{asked_by} needs a MuJoCo environment in which every actuator is a muscle with its own "
        f"action entry; {type(inner).__name__} has {found}."
    )


def sends_sigmoid(env: EnvBase | gym.Env, low: Array, high: Array) -> bool:
    """Whether actions within these bounds pass MyoSuite's sigmoid; otherwise they are excitations.

    Raises:
        ValueError: if neither is known to hold.
    """
    inner = simulator(env)
    if (low >= 0).all():
        return False
    if getattr(inner, "normalize_act", False) and (low == -1).all() and (high == 1).all():
        return True
    raise ValueError(
        f"{type(inner).__name__} has actions below 0 and does not define how they excite muscles; "
        "use excitations in [0, 1], or actions in [-1, 1] with the attribute normalize_act=True "
        "for MyoSuite's sigmoid."
    )
