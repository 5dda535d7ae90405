"""A point pushed by more actuators than it has dimensions: the smallest overactuated env.

Once as a TorchRL env with any batch size and nested keys, once as a Gymnasium env to vectorize.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymWrapper

OBSERVATION_DIM = 3
ACTION_DIM = 5
HORIZON = 4
# Column j of the matrix is what actuator j does to the point.
PUSH = torch.linspace(-1.0, 1.0, OBSERVATION_DIM * ACTION_DIM).view(ACTION_DIM, OBSERVATION_DIM)


def move(position: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return position + 0.1 * action @ PUSH


class PointEnv(EnvBase):
    """Episodes of ``HORIZON`` steps; the n-th episode of an env starts at 0.1 n in every axis."""

    def __init__(
        self,
        batch_size: tuple[int, ...] = (),
        nested: bool = False,
        low: float = -1.0,
        high: float = 1.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(batch_size=torch.Size(batch_size), device="cpu")
        self.prefix = ("agent",) if nested else ()
        shape = self.batch_size
        self.observation_spec = self._spec(
            "observation", Unbounded((*shape, OBSERVATION_DIM), dtype=dtype)
        )
        self.action_spec = self._spec("action", Bounded(low, high, shape=(*shape, ACTION_DIM)))
        self.reward_spec = self._spec("reward", Unbounded((*shape, 1)))
        flag = Binary(1, shape=(*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(
            {name: flag.clone() for name in ("done", "truncated", "terminated")}, shape=shape
        )
        self.episode = torch.zeros(*shape, 1)
        self.position = torch.zeros(*shape, OBSERVATION_DIM, dtype=dtype)
        self.age = torch.zeros(*shape, 1, dtype=torch.int64)

    def key(self, name: str) -> str | tuple[str, str]:
        return (*self.prefix, name) if self.prefix else name

    def _spec(self, name: str, leaf: Unbounded | Bounded) -> Composite:
        spec = Composite({name: leaf}, shape=self.batch_size)
        return Composite(agent=spec, shape=self.batch_size) if self.prefix else spec

    def _reset(self, tensordict: TensorDict | None, **kwargs) -> TensorDict:
        reset = None if tensordict is None else tensordict.get("_reset", None)
        reset = torch.ones_like(self.age, dtype=torch.bool) if reset is None else reset
        self.episode = self.episode + reset.float()
        start = (0.1 * self.episode).expand_as(self.position)
        self.position = torch.where(reset, start, self.position)
        self.age = torch.where(reset, 0, self.age)
        return self._data(reward=False)

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.position = move(self.position, tensordict[self.key("action")])
        self.age = self.age + 1
        return self._data(reward=True)

    def _data(self, reward: bool) -> TensorDict:
        over = self.age >= HORIZON
        data = TensorDict(
            {"done": over, "truncated": over, "terminated": torch.zeros_like(over)}, self.batch_size
        )
        data[self.key("observation")] = self.position.clone()
        if reward:
            data[self.key("reward")] = -self.position.float().square().sum(-1, keepdim=True)
        return data

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random."""


class TeamEnv(EnvBase):
    """A group ``agent`` of points, each with its own action, observation and reward."""

    AGENTS = 2

    def __init__(self, batch_size: tuple[int, ...] = ()) -> None:
        super().__init__(batch_size=torch.Size(batch_size), device="cpu")
        self.group_shape = torch.Size((*batch_size, self.AGENTS))
        self.observation_spec = self._spec("observation", Unbounded, OBSERVATION_DIM)
        self.action_spec = self._spec("action", Bounded, ACTION_DIM, low=-1.0, high=1.0)
        self.reward_spec = self._spec("reward", Unbounded, 1)

    def _spec(self, name: str, kind: type, size: int, **bounds: float) -> Composite:
        leaf = kind(shape=(*self.group_shape, size), **bounds)
        group = Composite({name: leaf}, shape=self.group_shape)
        return Composite(agent=group, shape=self.batch_size)

    def _reset(self, tensordict: TensorDict | None, **kwargs) -> TensorDict:
        self.position = (
            torch.arange(self.AGENTS).float()[:, None].expand(*self.group_shape, OBSERVATION_DIM)
        )
        return TensorDict(agent=self._group(), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.position = move(self.position, tensordict["agent", "action"])
        reward = -self.position.square().sum(-1, keepdim=True)
        data = TensorDict(agent=self._group(reward=reward), batch_size=self.batch_size)
        return data.set("done", torch.zeros(*self.batch_size, 1, dtype=torch.bool))

    def _group(self, **entries: torch.Tensor) -> TensorDict:
        observed = {"observation": self.position.clone(), **entries}
        return TensorDict(observed, batch_size=self.group_shape)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing here is random."""


class PointTask(gymnasium.Env):
    """The same point for Gymnasium."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

    def __init__(self, horizon: int = HORIZON) -> None:
        self.horizon = horizon
        self.episode = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.age = self.episode + 1, 0
        self.position = np.full(OBSERVATION_DIM, 0.1 * self.episode, np.float32)
        return self.position, {}

    def step(self, action):
        self.position = self.position + np.float32(0.1) * action @ PUSH.numpy()
        self.age += 1
        reward = -float(np.square(self.position).sum())
        return self.position, reward, False, self.age >= self.horizon, {}


def vectorized_point(num_envs: int = 3) -> GymWrapper:
    """A batch below the TorchRL layer; env i's episodes last 2 + i steps, so resets are partial."""
    tasks = [lambda horizon=2 + i: PointTask(horizon) for i in range(num_envs)]
    disabled = gymnasium.vector.AutoresetMode.DISABLED
    return GymWrapper(gymnasium.vector.SyncVectorEnv(tasks, autoreset_mode=disabled), device="cpu")
