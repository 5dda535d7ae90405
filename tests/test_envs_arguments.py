"""``env_kwargs``: arguments that a simulator reads are passed on, ignored ones are refused."""

import gymnasium as gym
import numpy as np
import pytest

from torchrl_etl.envs import make_env


class Forgiving(gym.Env):
    """Takes any argument, but reads only ``stiffness`` and, from ``kwargs``, ``recipe``."""

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, stiffness=1.0, **kwargs):
        self.stiffness, self.recipe = stiffness, kwargs.pop("recipe", None)

    def reset(self, *, seed=None, options=None):
        return np.full(1, self.stiffness, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, True, False, {}


gym.register("torchrl_etl_test/Forgiving-v0", entry_point=Forgiving, max_episode_steps=2)
FORGIVING = "torchrl_etl_test/Forgiving-v0"


def make_stiff(factor=1.0):
    return Forgiving(stiffness=factor)


gym.register("torchrl_etl_test/Stiff-v0", entry_point=make_stiff, max_episode_steps=2)


def test_arguments_in_the_signature_or_popped_from_kwargs_are_passed():
    env = make_env(FORGIVING, env_kwargs={"stiffness": 0.5, "recipe": "a"})
    assert env.reset()["observation"].item() == 0.5


def test_arguments_of_a_function_as_entry_point_are_passed():
    env = make_env("torchrl_etl_test/Stiff-v0", env_kwargs={"factor": 0.5})
    assert env.reset()["observation"].item() == 0.5
    with pytest.raises(ValueError, match="does not take"):
        make_env("torchrl_etl_test/Stiff-v0", env_kwargs={"nonsense": 3.0})


def test_arguments_of_gymnasium_are_accepted():
    assert make_env(FORGIVING, env_kwargs={"max_episode_steps": 7}).reset() is not None


def test_ignored_argument_is_refused_with_the_nearest_known_name():
    with pytest.raises(ValueError, match=r"ignores env_kwargs\.stifness.*they read stiffness"):
        make_env(FORGIVING, env_kwargs={"stifness": 0.5})


def test_arguments_of_myosuite_are_accepted_and_unknown_ones_refused():
    make_env("myoHandKeyTurn", env_kwargs={"frame_skip": 5, "goal_th": 1.0}).close()
    with pytest.raises(ValueError, match=r"myoHandKeyTurn ignores env_kwargs\.nonsense"):
        make_env("myoHandKeyTurn", env_kwargs={"nonsense": 3})


def test_dm_control_tasks_refuse_env_kwargs():
    with pytest.raises(ValueError, match="does not take env_kwargs"):
        make_env("cartpole-swingup", env_kwargs={"nonsense": 3})
