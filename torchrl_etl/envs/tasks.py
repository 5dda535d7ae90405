"""Task names: the paper's thirteen tasks, and what else :func:`make_env` accepts.

The thirteen need no simulator here, so names can be checked before workers start.
"""

from __future__ import annotations

import difflib
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, get_args

import gymnasium as gym

from torchrl_etl.checks import check_choice
from torchrl_etl.envs.myosuite import register_myosuite
from torchrl_etl.envs.quiet import dm_control_suite, quiet_compiler
from torchrl_etl.user_code import import_user_module

__all__ = ["Task", "episode_length", "list_tasks", "resolve_task"]

Goal = Literal["fixed", "random"]


@dataclass(frozen=True)
class Task:
    """One task: how to build it, and how its episodes end and count as solved.

    Attributes:
        name: Short name, e.g. ``"myoHandPose"``; the environment id if there is none.
        id: Environment id for ``goal="fixed"``.
        random_id: Environment id for ``goal="random"``, if the task has one.
        suite: ``"myosuite"``, ``"dm_control"`` or ``"gymnasium"``.
        episode_steps: Number of steps after which an episode is truncated. ``None`` without a
            limit and, for DMControl domains outside the paper, before the task is built.
        solved: Whether the task reports success; ``None`` means that :func:`make_env`
            finds out in an episode of uniform actions.
        solved_steps: Number of solved steps for an episode to count as solved; ``None`` means
            that its last step must be solved.
        goal: Which of the two goals is meant; ``None`` if an id does not tell.
        ends_early: Whether episodes can terminate; otherwise the simulation continues to the limit.

    Examples:
        >>> from torchrl_etl.envs import resolve_task
        >>> resolve_task("myoHandPose", goal="random").env_id
        'myoHandPoseRandom-v0'
    """

    name: str
    id: str
    random_id: str | None = None
    suite: Literal["myosuite", "dm_control", "gymnasium"] = "gymnasium"
    episode_steps: int | None = None
    solved: bool | None = None
    solved_steps: int | None = None
    goal: Goal | None = "fixed"
    ends_early: bool = True

    @property
    def env_id(self) -> str:
        """The environment id of the chosen goal."""
        return self.random_id if self.goal == "random" and self.random_id else self.id

    @property
    def goal_in_words(self) -> str:
        """``" (fixed goal)"`` and so on, for messages; empty without a goal."""
        return f" ({self.goal} goal)" if self.goal else ""

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The goals that the task offers."""
        if self.random_id:
            return ("fixed", "random")
        return ("random",) if "Random" in self.id else ("fixed",)


_MYOSUITE_STEPS = 6
"""MyoSuite's ``evaluate_success`` requires more than five solved steps."""

_SOLVED_ONCE = re.compile(r"myo\w*Challenge(ChaseTag|Soccer|TableTennis|OslRun)")
"""MyoChallenge tasks that end on success, as counted by its ``get_metrics``."""


def _hand(name: str, steps: int) -> Task:
    ids = f"{name}Fixed-v0", f"{name}Random-v0"
    return Task(name, *ids, "myosuite", steps, True, _MYOSUITE_STEPS)


def _myo(name: str, env_id: str, steps: int) -> Task:
    return Task(name, env_id, None, "myosuite", steps, True, _MYOSUITE_STEPS)


def _dm_control(name: str) -> Task:
    return Task(name, name, None, "dm_control", 1000, False)


_PAPER = (
    _hand("myoHandPose", 100),
    _hand("myoHandKeyTurn", 200),
    _hand("myoHandPenTwirl", 50),
    _myo("myoBaoding", "myoChallengeBaodingP1-v1", 200),
    _myo("myoDieReorient", "myoChallengeDieReorientP1-v0", 150),
    _myo("myoRelocate", "myoChallengeRelocateP1-v0", 150),
    _myo("myoLegWalk", "myoLegWalk-v0", 1000),
    _myo("myoLegStairTerrainWalk", "myoLegStairTerrainWalk-v0", 1000),
    _dm_control("humanoid-stand"),
    _dm_control("humanoid-walk"),
    _dm_control("humanoid-run"),
    _dm_control("dog-walk"),
    _dm_control("dog-run"),
)

_IDS = "torchrl_etl/Overactuated-v0", "torchrl_etl/OveractuatedRandom-v0"
_ANALYTIC = Task("overactuated", *_IDS, "gymnasium", 25, True, 6)

# These tasks have negative rewards and end on a drop, so dropping early can pay. The variants
# continue after a drop.
_FULL = tuple(
    replace(task, name=f"{task.name}Full", ends_early=False)
    for task in _PAPER
    if task.name in ("myoBaoding", "myoDieReorient", "myoRelocate")
)

# The Hand Pose of published results; MyoSuite 3's is a different task.
_MYO2 = replace(_hand("torchrl_etl/Myo2HandPose", 100), name="myo2HandPose")

_BY_NAME = {task.name: task for task in (*_PAPER, *_FULL, _MYO2, _ANALYTIC)}
_BY_ID = {
    env_id: replace(task, goal=goal)
    for task in (*_PAPER, _MYO2, _ANALYTIC)
    if task.suite != "dm_control"
    for goal, env_id in zip(get_args(Goal), (task.id, task.random_id), strict=True)
    if env_id is not None
}

_DM_CONTROL_NAME = re.compile(r"(\w+)-(?!v\d+$)(\w+)")


def list_tasks() -> tuple[Task, ...]:
    """Returns the paper's thirteen tasks, grouped as in the paper: hand, leg, DMControl.

    Examples:
        >>> from torchrl_etl.envs import list_tasks
        >>> len(list_tasks())
        13
        >>> [task.name for task in list_tasks() if "random" in task.goals]
        ['myoHandPose', 'myoHandKeyTurn', 'myoHandPenTwirl']
    """
    return _PAPER


def resolve_task(name: str, goal: Goal | None = None) -> Task:
    """Finds the task that a name stands for, without building it.

    Args:
        name (str): a short name of :func:`list_tasks`, ``"myo2HandPose"`` or ``"overactuated"``;
            any environment id registered with Gymnasium (MyoSuite's are registered on demand;
            ``"module:id"`` imports ``module`` first, also from the current folder); or any
            DMControl ``"domain-task"``, e.g. ``"cheetah-run"``.
        goal (str, optional): ``"fixed"`` or ``"random"``. Default: the fixed goal for a short
            name; for an id, the goal given by ``Fixed`` or ``Random`` in it.

    Returns:
        Task: the task, with ``goal`` filled in if it is known.

    Raises:
        ValueError: for an unknown name (with the nearest known ones), or a goal that the task does
            not have.
        ImportError: for ``"module:id"``, if there is no such module.

    Examples:
        >>> from torchrl_etl.envs import resolve_task
        >>> resolve_task("myoBaoding").env_id
        'myoChallengeBaodingP1-v1'
        >>> resolve_task("myoBaoding", goal="random")
        Traceback (most recent call last):
        ...
        ValueError: myoBaoding has no random goal; the tasks with both goals are myoHandPose, \
myoHandKeyTurn, myoHandPenTwirl, myo2HandPose, overactuated.
    """
    if not isinstance(name, str):
        raise TypeError(f"The task is a {type(name).__name__}; it must be a string.")
    if goal is not None:
        check_choice("goal", goal, get_args(Goal))
    if name in _BY_NAME:
        task = replace(_BY_NAME[name], goal=goal or "fixed")
    elif name in _BY_ID:
        task = _BY_ID[name]
        if goal not in (None, task.goal):
            raise ValueError(
                f"{name} already has the {task.goal} goal, but goal={goal!r} was given; leave goal "
                f"out, or pass the task {task.name!r}."
            )
    elif _in_dm_control(name):
        task = Task(name, name, suite="dm_control", solved=False, goal=goal or "fixed")
    elif _registered(name):
        task = _by_its_spec(name, goal)
    else:
        nearest = _nearest(name)
        hint = (
            f"the nearest known names are {', '.join(nearest)}" if nearest else "no name is close"
        )
        raise ValueError(
            f"Unknown task {name!r}; {hint}. list_tasks() gives the paper's tasks; any "
            "registered Gymnasium id and any DMControl 'domain-task' work too, and "
            "'module:id' imports the module that registers a task of your own."
        )
    if goal == "random" and "random" not in task.goals:
        both = ", ".join(t.name for t in _BY_NAME.values() if t.random_id)
        raise ValueError(f"{task.name} has no random goal; the tasks with both goals are {both}.")
    return task


def episode_length(name: str, goal: Goal | None = None) -> int | None:
    """Returns the number of steps after which a task truncates an episode.

    Args:
        name (str): as for :func:`resolve_task`.
        goal (str, optional): as for :func:`resolve_task`.

    Returns:
        int, optional: the number of steps, or ``None`` for a task without a limit. DMControl
        tasks outside the paper are built to find it.

    Examples:
        >>> from torchrl_etl.envs import episode_length
        >>> episode_length("myoHandPenTwirl"), episode_length("dog-run")
        (50, 1000)
    """
    task = resolve_task(name, goal)
    if task.suite == "dm_control" and task.episode_steps is None:
        with quiet_compiler():
            env = dm_control_suite().load(*task.id.split("-", 1))
        limit = env._step_limit  # in control steps; nothing public holds it
        return None if limit == float("inf") else int(limit)
    return task.episode_steps


def _in_dm_control(name: str) -> bool:
    match = _DM_CONTROL_NAME.fullmatch(name)
    return match is not None and match.groups() in dm_control_suite().ALL_TASKS


def _registered(name: str) -> bool:
    """Whether Gymnasium knows the id, after importing the module of ``"module:id"``."""
    module, _, env_id = name.rpartition(":")
    if module:
        # Gymnasium 1 loads no plugins, so nothing else runs a user's gymnasium.register.
        import_user_module(module, f"the task {name!r}; a task of your own is 'module:id'")
        if env_id not in gym.registry:
            raise ValueError(
                f"Importing {module!r} registers no task {env_id!r}; register it in that module "
                "with gymnasium.register, under an id with a version, such as 'MyTask-v0'."
            )
    elif env_id not in gym.registry:
        try:
            register_myosuite()
        except ImportError:  # rather a wrong name than a missing simulator?
            if not difflib.get_close_matches(name, [*_BY_NAME, *gym.registry], cutoff=0.8):
                raise
    return env_id in gym.registry


def _by_its_spec(name: str, goal: Goal | None) -> Task:
    """A task known only from its id and Gymnasium's registry."""
    env_id = name.rpartition(":")[2]
    spec = gym.spec(env_id)
    said = next((own for own in get_args(Goal) if own.capitalize() in env_id), None)
    if said is not None and goal not in (None, said):
        raise ValueError(
            f"{name} already has the {said} goal, but goal={goal!r} was given; leave goal out."
        )
    task = Task(name, env_id, None, episode_steps=spec.max_episode_steps, goal=said or goal)
    if not str(spec.entry_point).startswith("myosuite."):
        return task
    once = _SOLVED_ONCE.match(env_id) is not None
    return replace(task, suite="myosuite", solved_steps=1 if once else _MYOSUITE_STEPS)


def _nearest(name: str) -> list[str]:
    known = [*_BY_NAME, *gym.registry]
    with suppress(ImportError):
        known += ("-".join(pair) for pair in dm_control_suite().ALL_TASKS)
    lowered = {candidate.lower(): candidate for candidate in reversed(known)}
    found = difflib.get_close_matches(name.lower(), lowered, n=5, cutoff=0.5)
    return [lowered[candidate] for candidate in found]
