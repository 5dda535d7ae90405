"""Viewer state without a browser: what moves the body, how fast, and the results.

All controls of the viewer's page call a :class:`Session`, so they can be used and tested here.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type, step_mdp

from torchrl_etl.checks import check_choice, check_real
from torchrl_etl.envs import HeldJoints, Task, has_free_root, mujoco_state, root_joints
from torchrl_etl.envs.tasks import Goal
from torchrl_etl.modules import SynergyMap

__all__ = ["Driver", "Session", "Subject"]

Driver = Literal["policy", "sliders", "explorer"]

_SETTLING = 0.6
"""Simulated seconds for which a paused body follows a slider."""
_STEP = 0.02
"""Assumed duration in seconds of a step without a simulation clock."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Subject:
    """A task, and everything that can move its body.

    Args:
        name (str): name for messages, such as the run folder.
        task (Task): the task, with its goal.
        make_env (callable): makes a single simulator of the task for a given goal.
        actuators (sequence of str): names of the n actuators, in action order.

    Keyword Args:
        decoder (SynergyMap, optional): maps synergy coefficients to actions.
        policy (TensorDictModuleBase, optional): the policy that learned the task.
        explorer (TensorDictModuleBase, optional): stage 1's policy.
        direction_dim (int): size of the direction that ``explorer`` reads, 0 for none.
        episode_steps (int, optional): step limit of an episode, if the environment does not
            truncate earlier.
        first_seed (int): seed of episode 0.
        action_repeat (int): simulator steps per step of the environment; solved steps count these.
    """

    name: str
    task: Task
    make_env: Callable[[Goal | None], EnvBase]
    actuators: Sequence[str]
    decoder: SynergyMap | None = None
    policy: TensorDictModuleBase | None = None
    explorer: TensorDictModuleBase | None = None
    direction_dim: int = 0
    episode_steps: int | None = None
    first_seed: int = 0
    action_repeat: int = 1

    @property
    def drivers(self) -> list[Driver]:
        """Available drivers; the first is the default."""
        there = {"policy": self.policy, "sliders": self.decoder, "explorer": self.explorer}
        return [name for name, part in there.items() if part is not None]


class Session:
    """Steps a subject's simulator under its policy, sliders for its synergies, or stage 1's policy.

    Args:
        subject (Subject): the subject to show.

    Attributes:
        driver (str): what moves the body: ``"policy"``, ``"sliders"`` or ``"explorer"``.
        coefficients (Tensor): synergy coefficients from the sliders, or last policy output [d].
        direction (Tensor): unit vector that stage 1's policy follows [k].
        residual (bool): whether the policy's residual is applied.
        hold (bool): whether the body's free root is held in place while the sliders drive.
        playing (bool), speed (float): whether time advances, and how fast.
        episode (int): number of the episode; its seed is ``subject.first_seed`` plus this.
        steps, total_reward, solved_steps: totals of the current episode.
        solved (bool or None): whether the last step was solved; None if the task does not tell.
        over (bool): whether the episode has ended, see :meth:`step`.

    Raises:
        ValueError: if the subject has no drivers.

    Examples:
        >>> import torch
        >>> from torchrl_etl.envs import actuator_names, make_env, resolve_task
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> subject = Subject(
        ...     "an example",
        ...     resolve_task("overactuated"),
        ...     lambda goal: make_env("overactuated", goal=goal),
        ...     actuator_names("overactuated"),
        ...     decoder=SynergyDecoder(2, 16),
        ... )
        >>> session = Session(subject)
        >>> session.move(0, 0.5)  # a slider
        >>> session.step(), session.steps, session.coefficients
        (0.02, 1, tensor([0.5000, 0.0000]))
    """

    def __init__(self, subject: Subject) -> None:
        if not subject.drivers:
            raise ValueError(
                f"{subject.name} has neither a policy nor synergies, so nothing would move; pass a "
                "run that has begun to learn or has explored, or a synergy bundle."
            )
        self.subject = subject
        self.driver: Driver = subject.drivers[0]
        decoder = subject.decoder
        self.coefficients = torch.zeros(0 if decoder is None else decoder.num_synergies)
        self.direction = torch.eye(max(1, subject.direction_dim))[0, : subject.direction_dim]
        self.residual, self.hold = True, True
        self.playing, self.speed, self.episode = False, 1.0, 0
        self._budget = self._settling = 0.0
        self._enter(subject.make_env(subject.task.goal), subject.task.goal)

    def _enter(self, env: EnvBase, goal: Goal | None) -> None:
        self.goal, self.env = goal, env
        try:
            self.model, self.data = mujoco_state(self.env)
        except ValueError:  # the analytic environment has no body
            self.model = self.data = None
        self.root = None
        if has_free_root(self.env):
            self.root = HeldJoints(self.model, self.data, root_joints(self.model, self.data))
        self.reset()

    # User commands -----------------------------------------------------------------------------

    def drive(self, driver: Driver) -> None:
        """Select the driver.

        Raises:
            ValueError: if the subject has no such driver.
        """
        check_choice("driver", driver, self.subject.drivers)
        self.driver = driver
        if driver == "sliders" and self.root is not None:
            self.root.remember()

    def move(self, synergy: int, value: float) -> None:
        """Set one coefficient in [-1, 1] and let the sliders drive, even if paused."""
        self.drive("sliders")
        check_real("[-1, 1]", coefficient=value)
        self.coefficients = self.coefficients.clone()
        self.coefficients[synergy] = value
        self._settling = _SETTLING

    def center(self) -> None:
        """Set all coefficients to 0."""
        for synergy in range(len(self.coefficients)):
            self.move(synergy, 0.0)

    def follow(self, direction: Tensor) -> None:
        """Let stage 1's policy drive along a direction [k], which is normalized.

        Raises:
            ValueError: if the direction is zero or does not match the policy's size.
        """
        direction = torch.as_tensor(direction, dtype=torch.float32)
        if direction.shape != self.direction.shape or not direction.any():
            raise ValueError(
                f"The direction is {direction.tolist()}; it must be {len(self.direction)} numbers, "
                "not all zero."
            )
        self.drive("explorer")
        self.direction = torch.nn.functional.normalize(direction, dim=0)

    def choose_goal(self, goal: Goal) -> None:
        """Restart in a new simulator with the task's ``"fixed"`` or ``"random"`` goal.

        Raises:
            ValueError: if the task has no such goal.
        """
        check_choice("goal", goal, self.subject.task.goals)
        env = self.subject.make_env(goal)  # if this fails, the old simulator is kept
        self.close()
        self._enter(env, goal)

    def reset(self, episode: int | None = None) -> None:
        """Restart the current episode, or begin the given one."""
        self.episode = self.episode if episode is None else episode
        self.env.set_seed(self.subject.first_seed + self.episode)
        self._state = self.env.reset()
        self.steps = self.solved_steps = 0
        self.total_reward, self.over = 0.0, False
        self.solved = False if "solved" in self._state.keys() else None
        self.action = torch.zeros(len(self.subject.actuators))
        if self.root is not None:
            self.root.remember()

    # Simulation --------------------------------------------------------------------------------

    def advance(self, seconds: float, patience: float = 0.05) -> int:
        """Simulate ``seconds`` of wall time at ``speed``; returns the number of steps.

        No effect unless the session plays, or a body follows a slider. After ``patience`` seconds
        it drops the remaining time, so that a slow simulator does not block the page.
        """
        if not self._moving:
            self._budget = 0.0
            return 0
        self._budget += seconds * self.speed
        steps, until = 0, time.monotonic() + patience
        while self._moving and self._budget > _ROUNDING:
            passed = self.step()
            self._budget -= passed
            self._settling -= passed
            steps += 1
            if time.monotonic() > until:
                self._budget = 0.0
        return steps

    @property
    def _moving(self) -> bool:
        return self.playing or self._settling > _ROUNDING

    @torch.no_grad()
    def step(self) -> float:
        """One step of the environment; returns its duration in simulated seconds.

        After the end of an episode, sliders continue and policies begin the next episode.
        """
        if self.over and self.driver != "sliders":
            self.reset(self.episode + 1)
        before = 0.0 if self.data is None else self.data.time
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            after = self.env.step(self._act(self._state))
        if self.driver == "sliders" and self.hold and self.root is not None:
            import mujoco  # installed, since the model exists

            self.root.restore()
            mujoco.mj_forward(self.model, self.data)
        outcome = after["next"]
        self.action = after["action"].flatten()
        self.steps += 1
        self.total_reward += outcome["reward"].item()
        if self.solved is not None:
            self.solved = bool(outcome["solved"].any())
            self.solved_steps += self.subject.action_repeat * self.solved
        limit = self.subject.episode_steps
        self.over = bool(outcome["done"].any()) or (limit is not None and self.steps >= limit)
        self._state = step_mdp(after, keep_other=False)
        return _STEP if self.data is None else max(self.data.time - before, 1e-4)

    def _act(self, state: TensorDictBase) -> TensorDictBase:
        """The state with the driver's action."""
        decoder = self.subject.decoder
        if self.driver == "explorer":
            return self.subject.explorer(state.set("direction", self.direction))
        if self.driver == "sliders":
            missing = decoder.synergy_dim - decoder.num_synergies
            synergy = torch.nn.functional.pad(self.coefficients, (0, missing))
            return decoder(state.set(decoder.in_keys[0], synergy))
        state = self.subject.policy(state)
        if decoder is not None:
            synergy = state[decoder.in_keys[0]]
            self.coefficients = synergy[: decoder.num_synergies].clone()
            if not self.residual:
                synergy[decoder.num_synergies :] = 0.0
                state = decoder(state)
        return state

    @property
    def success(self) -> bool | None:
        """Whether the episode counts as solved so far; None if the task does not tell."""
        needed = self.subject.task.solved_steps
        return self.solved if needed is None else self.solved and self.solved_steps >= needed

    @property
    def has_residual(self) -> bool:
        """Whether the policy also has a residual action per muscle."""
        decoder = self.subject.decoder
        return decoder is not None and self.subject.policy is not None and decoder.residual > 0

    def close(self) -> None:
        self.env.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
