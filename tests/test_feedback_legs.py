"""The study's legs with feedback: what feedback adds to an action, and nothing at zero gains."""

import gymnasium as gym
import numpy as np

from studies.feedback_legs import ENV_ID
from torchrl_etl.envs import joint_torques, make_env, mujoco_state, muscle_changes

ACTION = np.full(80, 0.25, np.float32)


def _after(env: gym.Env, steps: int) -> np.ndarray:
    env.reset(seed=0)
    for _ in range(steps):
        observation, *_ = env.step(ACTION)
    env.close()
    return observation


def test_zero_gains_leave_the_task_unchanged():
    plain = make_env("myoLegWalk", seed=0)._env
    still = gym.make(ENV_ID, kp=0.0, kd=0.0, disable_env_checker=True)
    expected = _after(plain, 3)["observation"]
    np.testing.assert_allclose(_after(still, 3), expected, rtol=1e-6)


def test_feedback_answers_a_joint_displacement_with_its_synergy():
    env = gym.make(ENV_ID, kp=2.0, kd=0.0, disable_env_checker=True)
    env.reset(seed=0)
    body = make_env("myoLegWalk", seed=0)
    torques = joint_torques(body)
    model, _ = mujoco_state(body)
    joint = torques.joints.index("knee_angle_r")
    simulator = env.unwrapped
    simulator.data.qpos[model.joint("knee_angle_r").qposadr] += 0.1
    env.step(ACTION)
    expected = ACTION - 0.2 * muscle_changes(torques.matrix)[joint]
    np.testing.assert_allclose(simulator.data.ctrl, expected.clip(0, 1), atol=1e-6)
