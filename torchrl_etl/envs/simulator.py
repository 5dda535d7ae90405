"""The simulator underneath an environment."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym
from torchrl.envs import DMControlWrapper, EnvBase, GymWrapper
from torchrl.envs.batched_envs import BatchedEnvBase

__all__ = ["mujoco_state", "simulator"]


def simulator(env: EnvBase | gym.Env | gym.vector.VectorEnv) -> Any:
    """The (first) simulator under transforms, wrappers and vectorized environments.

    Examples:
        >>> from torchrl_etl.envs import make_env
        >>> type(simulator(make_env("overactuated", num_envs=2))).__name__
        'AnalyticOveractuated'
    """
    while not isinstance(env, gym.Env):
        if isinstance(env, gym.vector.VectorEnv):
            env = env.unwrapped.envs[0]
        elif isinstance(env, GymWrapper):
            env = env._env
        elif isinstance(env, DMControlWrapper):
            return env._env
        elif isinstance(env, BatchedEnvBase):
            raise ValueError(
                f"A {type(env).__name__} runs its simulators in workers; pass the environment of "
                "one worker."
            )
        elif hasattr(env, "base_env"):
            env = env.base_env
        else:
            raise ValueError(f"The simulator of a {type(env).__name__} cannot be reached.")
    return env.unwrapped


def mujoco_state(env: EnvBase) -> tuple[Any, Any]:
    """MuJoCo's ``MjModel`` and ``MjData`` of an environment.

    Raises:
        ValueError: if the environment does not run on MuJoCo.
    """
    inner = simulator(env)
    if hasattr(inner, "physics"):  # DMControl
        return inner.physics.model.ptr, inner.physics.data.ptr
    model, data = getattr(inner, "model", None), getattr(inner, "data", None)
    mujoco = sys.modules.get("mujoco")  # imported by every environment that runs on it
    if mujoco and isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
        return model, data
    name = type(inner).__name__
    raise ValueError(f"{name} does not run on MuJoCo, which is needed to draw or analyse bodies.")
