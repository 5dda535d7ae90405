"""Builds a task: simulator, small wrappers, one TorchRL environment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, GymWrapper

from torchrl_etl.checks import check_integer
from torchrl_etl.envs.action_space import check_action_space, flat_action
from torchrl_etl.envs.arguments import argument_errors, check_known
from torchrl_etl.envs.myosuite import register_myosuite
from torchrl_etl.envs.quiet import dm_control_suite, quiet_compiler
from torchrl_etl.envs.simulator import simulator
from torchrl_etl.envs.tasks import Goal, Task, resolve_task
from torchrl_etl.envs.wrappers import (
    SUCCESS_KEYS,
    FiniteGuard,
    FlatObservation,
    FullEpisodes,
    NamedObservation,
    RepeatedAction,
    SeededVectorEnv,
)
from torchrl_etl.extras import extra

__all__ = ["actuator_names", "make_env"]

_LONGEST_SEARCH = 1000
"""Maximum number of steps in the search for a task's success key."""


def make_env(
    name: str,
    *,
    num_envs: int = 1,
    goal: Goal | None = None,
    seed: int | None = None,
    device: torch.device | str | None = None,
    activations: bool = False,
    muscle_lengths: bool = False,
    action_repeat: int = 1,
    success_key: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
) -> EnvBase:
    """Builds a task as a TorchRL environment.

    MyoSuite, DMControl and Gymnasium tasks are built alike. With several environments, their
    simulators are stepped in turn below a single TorchRL environment of batch size ``[num_envs]``,
    so TorchRL's overhead occurs once per batch. Use several collector workers for parallelism.
    Simulators are imported inside this function, so worker processes register them on their own.

    Args:
        name (str): a task of :func:`~torchrl_etl.envs.list_tasks`, ``"overactuated"``, a registered
            Gymnasium id, ``"module:id"`` for one that ``module`` registers, or a DMControl
            ``"domain-task"``.

    Keyword Args:
        num_envs (int): number of simulators; one gives an environment of batch size ``[]``.
            Defaults to 1.
        goal (str, optional): ``"fixed"`` or ``"random"``, see
            :func:`~torchrl_etl.envs.resolve_task`.
        seed (int, optional): seeds the environment, as a later ``env.set_seed(seed)`` does. After
            ``env.set_seed(s); env.reset()``, a used environment and a fresh one give bit-identical
            rollouts for the same actions. Each simulator of a batch gets a different seed.
        device (torch.device, optional): device of the tensors; simulation stays on the CPU.
        activations (bool): adds ``activation``, the muscle activations in action units. Requires
            a body actuated only by muscles. Defaults to ``False``.
        muscle_lengths (bool): adds ``muscle_length``, the muscle-tendon lengths in metres.
            Requires a body actuated only by muscles. Defaults to ``False``.
        action_repeat (int): simulator steps per action. Their rewards are summed; time limits
            still count simulator steps. Defaults to 1.
        success_key (str, optional): the entry of ``info`` that means success. Default: the
            task's own, or else the first of ``solved``, ``is_success`` and ``success`` found in
            an episode of uniform actions (1,000 steps at most).
        env_kwargs (mapping, optional): passed to ``gymnasium.make``, or to
            ``dm_control.suite.load``.

    Keys:
        - ``observation`` [O], float32, flat. DMControl's parts are joined in alphabetical order.
        - ``action`` [n], float32, flat, within the simulator's bounds: [-1, 1] for MyoSuite's
          hands and arm and for DMControl, [0, 1] for MyoSuite's legs.
        - ``reward`` [1]; ``done``, ``terminated``, ``truncated`` [1]. Time limits truncate.
        - ``solved`` [1], bool, where the task defines it: whether the current step meets the
          task's criterion. ``False`` at reset.
        - ``activation`` [n], ``muscle_length`` [n], float32, in action order, if requested.

    Raises:
        ValueError: for an unknown name, a goal that the task lacks, ``env_kwargs`` that it does not
            take, or actions that are not continuous or not bounded, or whose bounds are equal. A
            running environment raises :class:`~torchrl_etl.envs.SimulationError` if a value is
            not finite.

    Examples:
        >>> from torchrl_etl.envs import make_env
        >>> env = make_env("overactuated", num_envs=2, seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["next", "observation"].shape, rollout["action"].shape
        (torch.Size([2, 3, 6]), torch.Size([2, 3, 16]))
        >>> rollout["next", "solved"].shape, rollout["next", "solved"].dtype
        (torch.Size([2, 3, 1]), torch.bool)
    """
    check_integer(1, num_envs=num_envs, action_repeat=action_repeat)
    task = resolve_task(name, goal)
    if action_repeat > (steps := task.episode_steps or action_repeat):
        raise ValueError(
            f"action_repeat is {action_repeat}, but an episode of {task.name} has {steps} steps; "
            "it must not be more than that."
        )
    build = partial(
        _build,
        task,
        activations=activations,
        muscle_lengths=muscle_lengths,
        action_repeat=action_repeat,
        env_kwargs=dict(env_kwargs or {}),
    )
    with quiet_compiler(), argument_errors(task.name, env_kwargs or {}):
        build = partial(build, success_key=success_key or _success_key(task, env_kwargs))
        if num_envs == 1:
            env = GymWrapper(build(), device=device)
        else:
            env = _BatchedGymWrapper(SeededVectorEnv([build] * num_envs), device=device)
    if seed is not None:
        env.set_seed(seed)
    return env


def actuator_names(env: str | EnvBase | gym.Env) -> list[str]:
    """Returns the names of a task's actuators, in the order of its action.

    A suffix ``_r`` that every name has is removed, since MyoSuite uses it for some hands and not
    for others. Hand Pose and Key Turn then have the same muscle names. Legs, which have both
    sides, keep their suffixes.

    Args:
        env (str or EnvBase or gymnasium.Env): a task's name or an environment.

    Returns:
        list of str: one name for each entry of the action, or ``actuator_0`` and so on without a
        MuJoCo model. If the model has more actuators than the action has entries, the names are
        those of its muscles if their number fits, otherwise ``actuator_0`` and so on.

    Examples:
        >>> from torchrl_etl.envs import actuator_names
        >>> actuator_names("overactuated")[:2]
        ['muscle_0', 'muscle_1']
    """
    if isinstance(env, str):
        with quiet_compiler():
            built = _simulator(resolve_task(env), {})[0]
        try:
            return actuator_names(built)
        finally:
            built.close()
    simulation = simulator(env)
    names = _raw_actuator_names(simulation)
    suited = hasattr(simulation, "action_space")  # otherwise a bare dm_control environment
    space = simulation.action_space if suited else simulation.action_spec()
    count = math.prod(space.shape)
    if len(names) > count:  # the simulator drives the rest itself, for example a prosthesis
        first = getattr(getattr(simulation, "model", None), "actuator_actadr", ())
        names = [name for name, at in zip(names, first, strict=False) if at >= 0]
    if len(names) != count:
        return [f"actuator_{i}" for i in range(count)]
    if len(set(names)) < len(names):  # some models have unnamed actuators or duplicate names
        names = [f"{name or 'actuator'}_{i}" for i, name in enumerate(names)]
    if all(name.endswith("_r") for name in names):
        return [name.removesuffix("_r") for name in names]
    return names


class _BatchedGymWrapper(GymWrapper):
    """``GymWrapper`` whose reset accepts a tensordict without a mask, and a mask on any device.

    Such a tensordict carries entries for transforms at reset, such as a chosen direction. TorchRL
    0.14 requires the mask to be there and on the CPU.
    """

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None:
            mask = TensorDict({"_reset": mask.cpu()}, batch_size=self.batch_size)
        return super()._reset(mask, **kwargs)


def _raw_actuator_names(simulation: Any) -> list[str]:
    if hasattr(simulation, "actuator_names"):
        return [str(name) for name in simulation.actuator_names]
    if hasattr(simulation, "physics"):
        model: Any = simulation.physics.model
        return [model.id2name(i, "actuator") for i in range(model.nu)]
    model = getattr(simulation, "model", None)
    if not hasattr(model, "actuator"):
        return []
    return [model.actuator(i).name for i in range(model.nu)]


def _build(
    task: Task,
    *,
    activations: bool,
    muscle_lengths: bool,
    action_repeat: int,
    success_key: str | None,
    env_kwargs: dict[str, Any],
) -> gym.Env:
    env, faults = _simulator(task, env_kwargs)
    space = env.observation_space
    if isinstance(space, spaces.Dict) and all(isinstance(s, spaces.Box) for s in space.values()):
        env = FlatObservation(env)
    elif not isinstance(space, spaces.Box) or len(space.shape) != 1:
        env = FlattenObservation(env)
    if not task.ends_early:
        env = FullEpisodes(env)
    env = FiniteGuard(env, task.name, faults)
    if action_repeat > 1:
        env = RepeatedAction(env, action_repeat)
    return NamedObservation(
        env, success_key, activations=activations, muscle_lengths=muscle_lengths
    )


def _simulator(
    task: Task, env_kwargs: dict[str, Any]
) -> tuple[gym.Env, tuple[type[Exception], ...]]:
    """Builds the environment with a flat action; also returns its errors for divergence."""
    if task.suite == "dm_control":
        suite = dm_control_suite()
        with extra("dm_control"):
            from dm_control.rl.control import PhysicsError
            from shimmy.dm_control_compatibility import DmControlCompatibilityV0

        domain, task_name = task.env_id.split("-", 1)
        env = DmControlCompatibilityV0(suite.load(domain, task_name, **env_kwargs))
        faults: tuple[type[Exception], ...] = (PhysicsError,)
    else:
        if task.suite == "myosuite":
            register_myosuite()
        # TorchRL's specs and FiniteGuard replace Gymnasium's checks of every step.
        env, faults = gym.make(task.env_id, disable_env_checker=True, **env_kwargs), ()
    try:
        if env_kwargs and task.suite != "dm_control":  # dm_control rejects unknown ones itself
            check_known(env, task.name, env_kwargs)
        check_action_space(env.action_space, task.name)
    except ValueError:
        env.close()
        raise
    return env if len(env.action_space.shape) == 1 else flat_action(env), faults


def _success_key(task: Task, env_kwargs: Mapping[str, Any] | None) -> str | None:
    """The task's own key, or the one found in an episode of a temporary simulator.

    Some tasks report success only in the last ``info``. The temporary simulator keeps the seed
    and state of the search away from those in use.
    """
    if task.solved is not None:
        return "solved" if task.solved else None
    env = _simulator(task, dict(env_kwargs or {}))[0]
    try:
        env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(_LONGEST_SEARCH):
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            found = next((key for key in SUCCESS_KEYS if key in info), None)
            if found is not None or terminated or truncated:
                return found
        return None
    finally:
        env.close()
