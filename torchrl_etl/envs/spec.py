"""Sizes, bounds and actuator names of an environment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from torchrl_etl.envs.factory import actuator_names

__all__ = ["EnvironmentSpec"]


class EnvironmentSpec(NamedTuple):
    """Everything that a learner needs to know of an environment, read once.

    Attributes:
        observation_dim (int): O.
        action_spec (Bounded): bounds of the action [n], unbatched.
        actuators (tuple of str): names, in action order.

    Examples:
        >>> from torchrl_etl.envs import EnvironmentSpec, make_env
        >>> spec = EnvironmentSpec.of(make_env("overactuated"))
        >>> spec.observation_dim, spec.action_dim, spec.actuators[0]
        (6, 16, 'muscle_0')
    """

    observation_dim: int
    action_spec: Bounded
    actuators: tuple[str, ...]

    @classmethod
    def of(cls, env: EnvBase, device: torch.device | str | None = None) -> EnvironmentSpec:
        action_spec = env.full_action_spec_unbatched["action"]
        return cls(
            env.observation_spec["observation"].shape[-1],
            action_spec if device is None else action_spec.to(device),
            tuple(actuator_names(env)),
        )

    @property
    def action_dim(self) -> int:
        return self.action_spec.shape[-1]

    @property
    def device(self) -> torch.device:
        return self.action_spec.device

    @property
    def low(self) -> torch.Tensor:
        return self.action_spec.space.low

    @property
    def high(self) -> torch.Tensor:
        return self.action_spec.space.high
