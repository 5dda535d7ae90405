"""Leg Walk with feedback from joint angles: does fast feedback make synergies pay off?

``env=studies.feedback_legs:FeedbackLegWalk-v0``, from the project's root, is myoLegWalk with
feedback through the synergies of ``synergies=body``. Each step adds them with coefficients

    Kp (q0 - q) - Kd q'

for its 14 joints, clamped to [-1, 1]; q0 is the posture after a reset. A policy's coefficient then
shifts its joint's target angle by at most 1 / Kp. ``+env_kwargs.kp=0 +env_kwargs.kd=0`` gives the
unmodified task.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from torchrl_etl.envs import joint_torques, make_env, muscle_changes
from torchrl_etl.envs.myosuite import register_myosuite

TASK = "myoLegWalk"
ENV_ID = "FeedbackLegWalk-v0"


class JointFeedback(gym.Wrapper):
    """Adds the body's synergies with coefficients Kp (q0 - q) - Kd q' to the action, in [0, 1].

    Args:
        env (gym.Env): a leg task of MyoSuite, whose actions are excitations.

    Keyword Args:
        kp (float): coefficient per rad, at least 0.
        kd (float): coefficient per rad/s, at least 0.
    """

    def __init__(self, env: gym.Env, *, kp: float, kd: float) -> None:
        super().__init__(env)
        self._kp, self._kd = kp, kd
        body = make_env(TASK, seed=0)
        body.reset()
        torques = joint_torques(body)
        body.close()
        self._changes = muscle_changes(torques.matrix)
        model = env.unwrapped.model
        joints = [model.joint(name).id for name in torques.joints]
        self._angles, self._speeds = model.jnt_qposadr[joints], model.jnt_dofadr[joints]

    def reset(self, **options: Any):
        start = self.env.reset(**options)
        self._posture = self.unwrapped.data.qpos[self._angles].copy()
        return start

    def step(self, action: np.ndarray):
        data = self.unwrapped.data
        stretch = self._posture - data.qpos[self._angles]
        answer = self._kp * stretch - self._kd * data.qvel[self._speeds]
        moved = action + answer.clip(-1, 1) @ self._changes
        return self.env.step(moved.clip(0, 1).astype(np.float32))


def make(*, kp: float = 1.0, kd: float = 0.1, **options: Any) -> gym.Env:
    """Builds the task; options are those of myoLegWalk."""
    register_myosuite()
    inner = gym.make(f"{TASK}-v0", disable_env_checker=True, **options).unwrapped
    return JointFeedback(inner, kp=kp, kd=kd)


gym.register(ENV_ID, entry_point=make, max_episode_steps=1000)
