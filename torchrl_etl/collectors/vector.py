"""A collector that steps a vector of simulators without TorchRL's per-step overhead."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import itemgetter
from typing import Any

import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.collectors import Collector
from torchrl.envs import (
    EnvBase,
    GymWrapper,
    TransformedEnv,
    set_exploration_type,
)
from torchrl.envs.transforms import Transform
from torchrl.modules import RandomPolicy

from torchrl_etl.collectors.array_transform import ArrayTransform, has_array_form, on_arrays
from torchrl_etl.collectors.policy_on_arrays import Arrays, PolicyOnArrays

__all__ = ["VectorCollector"]

_NOT_TAKEN = ("replay_buffer", "max_frames_per_traj", "track_policy_version", "compact_obs")


class VectorCollector(Collector):
    """TorchRL's ``Collector``, several times cheaper per step on vectorized Gymnasium tasks.

    The environment is :func:`~torchrl_etl.envs.make_env` with ``num_envs`` above one. Allowed
    transforms are ``RewardSum``, ``InitTracker`` and those with the methods on arrays of
    :class:`~torchrl_etl.collectors.ArrayTransform`, such as
    :class:`~torchrl_etl.transforms.DirectionPrimer` and
    :class:`~torchrl_etl.transforms.LatentAction`.

    TorchRL's specs, clones and containers cost more per step than a hand's physics. This rollout
    does the same arithmetic on arrays and fills one tensordict at the end. Its transitions are
    bitwise equal to those of ``Collector``.

    The collector has its own random state, reset by :meth:`set_seed`. Its data depend only on the
    seed and the weights, not on the process or on other code in it.

    Args:
        create_env_fn (EnvBase or callable): the environment, or a function that builds it.
        policy (TensorDictModule): behavior policy. Default: random actions. A sequence of plain
            modules of ``torch.nn``, TensorDict, TorchRL and this package is traced into one graph
            on tensors. A policy that a trace might not capture is called with a tensordict, with a
            warning if a module from outside this package is the cause.
        **kwargs: see :class:`torchrl.collectors.Collector`. The policy is trusted, and the batch
            is one preallocated tensordict.

    Raises:
        ValueError: for any other environment, or for ``replay_buffer``, ``max_frames_per_traj``,
            ``track_policy_version`` and ``compact_obs``. Use ``torchrl.collectors.Collector``
            for these.

    Examples:
        >>> from torchrl.envs import RewardSum, TransformedEnv
        >>> from torchrl_etl.collectors import VectorCollector
        >>> from torchrl_etl.envs import make_env
        >>> from torchrl_etl.modules import make_actor
        >>> env = TransformedEnv(make_env("overactuated", num_envs=2, seed=0), RewardSum())
        >>> actor = make_actor({"observation": 6}, env.full_action_spec_unbatched["action"])
        >>> collector = VectorCollector(env, actor, frames_per_batch=8, total_frames=8)
        >>> [batch["next", "reward"].shape for batch in collector]
        [torch.Size([2, 4, 1])]
    """

    def __init__(
        self,
        create_env_fn: EnvBase | Callable[[], EnvBase],
        policy: TensorDictModuleBase | None = None,
        **kwargs: Any,
    ) -> None:
        given = [name for name in _NOT_TAKEN if kwargs.get(name) not in (None, False, -1)]
        if given:
            raise ValueError(
                f"VectorCollector takes no {given[0]}; leave it out, or use "
                "torchrl.collectors.Collector."
            )
        # Taken before TorchRL's constructor, which resets the environment and so draws.
        self._random = torch.get_rng_state()
        kwargs |= {
            "trust_policy": True,
            "auto_register_policy_transforms": False,
            "use_buffers": True,
        }
        super().__init__(create_env_fn, policy, **kwargs)
        self._simulators, self._transforms = _take_apart(self.env)
        self._action_of = _action_of(self._transforms)
        self._policy_on_arrays = PolicyOnArrays(self._wrapped_policy)
        foreign = sorted(kind.__name__ for kind in self._policy_on_arrays.foreign)
        if foreign and not isinstance(self._wrapped_policy, RandomPolicy):
            warnings.warn(
                f"The policy is called with a tensordict at each step, which is slower than a "
                f"traced graph: a graph may miss what {', '.join(foreign)} does (hooks, branches, "
                "counts, log-probabilities).",
                stacklevel=3,
            )

    @staticmethod
    def takes(transform: Transform) -> bool:
        """Whether the collector supports this transform."""
        return has_array_form(transform)

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the simulators and the collector's own random numbers."""
        self._random = torch.Generator().manual_seed(seed).get_state()
        return super().set_seed(seed, static_seed)

    def reset(self, index: Any = None, **kwargs: Any) -> None:
        """Start new episodes; see :meth:`torchrl.collectors.Collector.reset`."""
        with self._own_random_numbers():
            super().reset(index, **kwargs)

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """One batch, [num_envs, time]."""
        with self._own_random_numbers(), set_exploration_type(self.exploration_type):
            if self._should_use_random_frames() or self.reset_at_each_iter or self.interruptor:
                return super().rollout()
            if self.pre_collect_hook is not None:
                self.pre_collect_hook()
            return self._maybe_set_truncated(self._fill(self._final_rollout))

    @contextmanager
    def _own_random_numbers(self) -> Iterator[None]:
        outside = torch.get_rng_state()
        torch.set_rng_state(self._random)
        try:
            yield
        finally:
            self._random = torch.get_rng_state()
            torch.set_rng_state(outside)

    def _fill(self, batch: TensorDictBase) -> TensorDictBase:
        self._policy_on_arrays.refresh()
        carrier = self._carrier
        recorded = set(batch.keys(True, True))
        now: Arrays = {key: value.numpy(force=True) for key, value in carrier.items(True, True)}
        rows: dict[NestedKey, list[np.ndarray]] = defaultdict(list)
        for _ in range(self.frames_per_batch):
            now |= self._policy_on_arrays(now, self.policy_device)  # stays, for stateful policies
            after = self._step(now)
            for key in now.keys() & recorded:
                rows[key].append(now[key])
            for key, value in after.items():
                rows["next", key].append(value)
            now = {key: after.get(key, value) for key, value in now.items()}
            done = after["done"].squeeze(-1)
            if done.any():
                now |= self._restart(now, done)
        for key, values in rows.items():
            batch[key].copy_(torch.from_numpy(np.stack(values, axis=1)))
        for key, value in now.items():
            carrier.set(key, torch.tensor(value))  # a copy: a policy may reuse its output buffers
        return batch

    def _step(self, now: Arrays) -> Arrays:
        """The entries of the step below ``"next"``."""
        action = self._action_of(now)
        observations, reward, terminated, truncated, _ = self._simulators.step(action)
        after = _named(observations)
        after["reward"] = reward.astype(np.float32)[:, None]
        after["terminated"], after["truncated"] = terminated[:, None], truncated[:, None]
        after["done"] = after["terminated"] | after["truncated"]
        for transform in self._transforms:
            transform.array_step(now, after)
        return after

    def _restart(self, now: Arrays, done: np.ndarray) -> Arrays:
        """Root entries of the next step, with those of ended episodes reset."""
        fresh = _named(self._simulators.reset(options={"reset_mask": done})[0])
        for key in self.env.done_keys:
            fresh[key] = np.zeros_like(now[key])
        for transform in self._transforms:
            transform.array_reset(now, fresh, done)
        if self.track_traj_ids:
            key = ("collector", "traj_ids")
            fresh[key] = now[key].copy()
            fresh[key][done] = self._traj_pool.get_traj_and_increment(int(done.sum())).numpy()
        return fresh


def _named(observations: Arrays | np.ndarray) -> Arrays:
    return observations if isinstance(observations, dict) else {"observation": observations}


def _take_apart(env: EnvBase) -> tuple[SyncVectorEnv, list[ArrayTransform]]:
    """The simulators of an environment, and its transforms from the inside out."""
    transforms: list[Transform] = []
    while isinstance(env, TransformedEnv):
        transforms = [*getattr(env.transform, "transforms", [env.transform]), *transforms]
        env = env.base_env
    found = [on_arrays(transform) for transform in transforms]
    foreign = [part for part, its in zip(transforms, found, strict=True) if its is None]
    if foreign or not isinstance(env, GymWrapper) or not isinstance(env._env, SyncVectorEnv):
        what = type(foreign[0]).__name__ if foreign else f"{type(env).__name__} of one simulator"
        raise ValueError(
            "VectorCollector supports make_env(..., num_envs=2 or more) with RewardSum, "
            "InitTracker and transforms that have array_step and array_reset, but the environment "
            f"has a {what}; use torchrl.collectors.Collector for it."
        )
    if env.wrapper_frame_skip != 1 or env.info_dict_reader:
        raise ValueError(
            "VectorCollector steps simulators directly, which skips frame_skip and readers of info "
            f"of the {type(env).__name__}; use make_env(..., action_repeat=...), or "
            "torchrl.collectors.Collector."
        )
    return env._env, found


def _action_of(transforms: list[ArrayTransform]) -> Callable[[Arrays], np.ndarray]:
    """Gives the simulators' action: the policy's, or that of a transform with ``array_action``."""
    decoders = [transform for transform in transforms if hasattr(transform, "array_action")]
    if len(decoders) > 1:
        names = " and ".join(type(transform).__name__ for transform in decoders)
        raise ValueError(
            f"The environment has {names}, and VectorCollector takes one transform of the action; "
            "use torchrl.collectors.Collector for it."
        )
    return decoders[0].array_action if decoders else itemgetter("action")
