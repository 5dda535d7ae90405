"""Small Gymnasium wrappers between a simulator and TorchRL's ``GymWrapper``.

All entries for TorchRL go through a dict observation, not through ``info``. Unlike ``info``, it is
declared in the specs, survives partial resets, and is batched by Gymnasium's vector environments
without per-key work.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from torchrl_etl.envs.muscles import muscle_state, sends_sigmoid

__all__ = [
    "SUCCESS_KEYS",
    "FiniteGuard",
    "FlatObservation",
    "FullEpisodes",
    "NamedObservation",
    "RepeatedAction",
    "SeededVectorEnv",
    "SimulationError",
]

SUCCESS_KEYS = ("solved", "is_success", "success")
"""Entries of ``info`` that mean success, in order of preference."""


class SimulationError(RuntimeError):
    """A simulation diverged, a value is not finite, or an observation does not fit its space."""


class FlatObservation(gym.ObservationWrapper):
    """Concatenates the boxes of a dict observation, in the order of its space.

    Gymnasium's ``FlattenObservation`` does the same for any space, but takes 50 µs per step of
    DMControl's dog, a twentieth of its physics.
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self._keys = list(env.observation_space)
        self.observation_space = spaces.flatten_space(env.observation_space)

    def observation(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        return np.concatenate([np.ravel(observation[key]) for key in self._keys])


class FullEpisodes(gym.Wrapper):
    """Ignores termination, so that only the time limit ends an episode.

    With negative rewards, ending an episode early pays. Continuing the simulation removes this
    incentive without adding a reward.
    """

    def step(self, action: np.ndarray):
        observation, reward, _, truncated, info = self.env.step(action)
        return observation, reward, False, truncated, info


class RepeatedAction(gym.Wrapper):
    """Repeats every action for several steps, or until the episode ends, and sums the rewards.

    Observation, end flags and ``info`` are from the last of these steps. ``frame_skip`` of
    TorchRL's ``GymWrapper`` would stop a whole batch when one of its simulators ends.
    """

    def __init__(self, env: gym.Env, steps: int):
        super().__init__(env)
        self._steps = steps

    def step(self, action: np.ndarray):
        total = 0.0
        for _ in range(self._steps):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


class FiniteGuard(gym.Wrapper):
    """Converts to float32, and raises on the first non-finite action, observation or reward.

    The :class:`SimulationError` gives the entries, the episode and the step. It also replaces
    ``faults``, the exceptions by which a simulator itself reports divergence.
    """

    def __init__(self, env: gym.Env, name: str, faults: tuple[type[Exception], ...] = ()):
        super().__init__(env)
        self.observation_space = _as_float32(env.observation_space)
        self.action_space = _as_float32(env.action_space)
        self._name = name
        self._faults = faults
        self._seed: int | None = None
        self._episode = 0
        self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        if seed is not None:
            self._seed, self._episode = seed, 0
        self._episode += 1
        self._step = 0
        observation, info = self.env.reset(seed=seed, options=options)
        observation = np.asarray(observation, dtype=np.float32)
        if observation.shape != (expected := self.observation_space.shape):
            what = f"observation has shape {observation.shape} but its space has {expected}"
            raise self._error(what, "let observation_space match what reset and step return")
        self._check("observation", observation)
        return observation, info

    def step(self, action: np.ndarray):
        self._step += 1
        self._check("action", action, "it is from the policy: look for a diverged loss or network")
        try:
            observation, reward, *ends_and_info = self.env.step(action)
        except self._faults as fault:
            raise self._error(f"simulator diverged ({fault})") from fault
        observation = np.asarray(observation, dtype=np.float32)
        self._check("observation", observation)
        self._check("reward", reward)
        return observation, reward, *ends_and_info

    def _check(self, what: str, value: Any, cure: str | None = None) -> None:
        # A finite squared norm proves that all entries are finite: one fast product nearly always
        # suffices. It also overflows for entries beyond 1e19.
        if not math.isfinite(np.vdot(value, value)):
            self._report(what, value, cure)

    def _report(self, what: str, value: Any, cure: str | None) -> None:
        bad = np.flatnonzero(~np.isfinite(value))
        if bad.size:
            shown = ", ".join(map(str, bad[:8])) + (", ..." if bad.size > 8 else "")
            where = "" if np.ndim(value) == 0 else f" (entries {shown} of {np.size(value)})"
            raise self._error(f"{what} is not finite{where}", cure)

    def _error(self, what: str, cure: str | None = None) -> SimulationError:
        seed = "never seeded" if self._seed is None else f"since seed {self._seed}"
        cure = cure or (
            "if it is rare, continue with resume=RUN restart_seed=1, which collects other "
            "episodes; otherwise make the actions smaller or smoother"
        )
        return SimulationError(
            f"{self._name}: the {what} at step {self._step} of episode {self._episode} ({seed}); "
            f"{cure}."
        )


class NamedObservation(gym.Wrapper):
    """A dict observation of ``observation`` and, on request, ``solved`` and the muscle state.

    Drops ``info``: MyoSuite's nested dicts are slow to batch, and nothing downstream reads them.

    Args:
        env (gym.Env): an environment with an array as observation.
        success_key (str, optional): the entry of ``info`` that becomes ``solved``, a boolean of
            shape [1] that is ``False`` at reset. ``None`` means that there is no such entry.
        activations (bool): whether to add ``activation``, the muscle activations in action units,
            shape [n]. Requires a body actuated only by muscles.
        muscle_lengths (bool): whether to add ``muscle_length``, MuJoCo's ``actuator_length`` in
            action order, shape [n]: muscle-tendon lengths in metres. Requires a body actuated
            only by muscles.

    Equation:
        MyoSuite's hand and arm tasks excite a muscle by :math:`u = \\sigma(5(a - 1/2))`, so an
        activation :math:`x` corresponds to the action :math:`a = 1/2 + \\ln(x / (1 - x)) / 5`,
        clipped to the action's bounds. In leg tasks, actions are excitations, so :math:`a = x`.

    Raises:
        ValueError: if ``activations`` or ``muscle_lengths`` is requested and the environment does
            not provide them, see :mod:`~torchrl_etl.envs.muscles`.
    """

    def __init__(
        self,
        env: gym.Env,
        success_key: str | None = None,
        *,
        activations: bool = False,
        muscle_lengths: bool = False,
    ):
        super().__init__(env)
        self._success_key, self._sought = success_key, success_key is not None
        self._activations, self._muscle_lengths = activations, muscle_lengths
        entries: dict[str, spaces.Space] = {"observation": env.observation_space}
        if success_key is not None:
            entries["solved"] = spaces.Box(0, 1, (1,), np.bool_)
        if activations:
            muscle_state(env, "activations=True (for method=sar or fit.actions=activation)")
            self._sigmoid = sends_sigmoid(env, env.action_space.low, env.action_space.high)
            entries["activation"] = env.action_space
        if muscle_lengths:
            muscle_state(env, "muscle_lengths=True (for method=dep)")
            shape = env.action_space.shape
            entries["muscle_length"] = spaces.Box(-np.inf, np.inf, shape, np.float32)
        self.observation_space = spaces.Dict(entries)

    def reset(self, **kwargs: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        observation, _ = self.env.reset(**kwargs)
        return self._name_parts(observation, False), {}

    def step(self, action: np.ndarray):
        observation, reward, terminated, truncated, info = self.env.step(action)
        solved = bool(np.any(info.get(self._success_key, False)))
        if self._sought:
            self._seek(info, terminated or truncated)
        return self._name_parts(observation, solved), reward, terminated, truncated, {}

    def _seek(self, info: Mapping[str, Any], ended: bool) -> None:
        """Warn if no step of the first episode has the key."""
        missing = self._success_key not in info
        self._sought = missing and not ended
        if missing and ended:
            warnings.warn(
                f"success_key is {self._success_key!r}, but info had no such entry in the first "
                f"episode (it has {', '.join(map(str, info)) or 'nothing'}); steps without it do "
                "not count as solved.",
                RuntimeWarning,
                stacklevel=2,
            )

    def _name_parts(self, observation: np.ndarray, solved: bool) -> dict[str, np.ndarray]:
        parts = {"observation": observation}
        if self._success_key is not None:
            parts["solved"] = np.array([solved])
        if self._activations:
            parts["activation"] = self._activation()
        if self._muscle_lengths:
            parts["muscle_length"] = self.unwrapped.data.actuator_length.astype(np.float32)
        return parts

    def _activation(self) -> np.ndarray:
        simulation = self.unwrapped
        activation = simulation.data.act[simulation.model.actuator_actadr]
        if self._sigmoid:
            # Activation is exactly zero after a reset: log gives -inf, clipped to the lower bound.
            with np.errstate(divide="ignore"):
                activation = 0.5 + np.log(activation / (1.0 - activation)) / 5.0
        bounds = self.action_space
        return np.clip(activation, bounds.low, bounds.high).astype(np.float32)


class SeededVectorEnv(SyncVectorEnv):
    """Steps copies of an environment in turn, with independent seeds derived from one.

    The first copy gets the seed itself and reproduces a single environment. The others get
    statistically independent seeds. With Gymnasium's ``seed + i``, copies in workers whose seeds
    are close would repeat each other.
    """

    def __init__(self, env_fns):
        # TorchRL itself resets environments that are done.
        super().__init__(env_fns, autoreset_mode=AutoresetMode.DISABLED)

    def step(self, actions: np.ndarray):
        # The base class's step, specialized to dict observations for speed.
        for i, env in enumerate(self.envs):
            parts, self._rewards[i], self._terminations[i], self._truncations[i], _ = env.step(
                actions[i]
            )
            self._env_obs[i] = parts
            for name, part in parts.items():
                self._observations[name][i] = part
        observations = {name: part.copy() for name, part in self._observations.items()}
        ends = self._terminations.copy(), self._truncations.copy()
        return observations, self._rewards.copy(), *ends, {}

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None):
        if isinstance(seed, (int, np.integer)):
            others = np.random.SeedSequence(int(seed)).generate_state(self.num_envs - 1)
            seed = [int(seed), *map(int, others)]
        return super().reset(seed=seed, options=options)


def _as_float32(space: spaces.Box) -> spaces.Box:
    with np.errstate(over="ignore"):
        low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    return spaces.Box(low, high, dtype=np.float32)
