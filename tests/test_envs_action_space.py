"""Action spaces: boxes of any shape become flat actuators; others are refused in one sentence."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs import check_env_specs

from torchrl_etl.envs import actuator_names, make_env


class Takes(gym.Env):
    """Observes the last action, flattened, and checks that actions have the shape of the space."""

    def __init__(self, space):
        self.action_space = space
        size = int(np.prod(space.shape)) if isinstance(space, spaces.Box) else 1
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,))
        self.size = size

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(self.size, np.float32), {}

    def step(self, action):
        assert np.shape(action) == self.action_space.shape
        return np.ravel(action).astype(np.float32), 0.0, False, False, {}


TAKES = "torchrl_etl_test/Takes-v0"
gym.register(TAKES, entry_point=Takes, max_episode_steps=5)


def env_with_space(space: spaces.Space, **options):
    return make_env(TAKES, env_kwargs={"space": space}, **options)


def box(low, high, dtype=np.float32) -> spaces.Box:
    return spaces.Box(np.array(low, dtype), np.array(high, dtype), dtype=dtype)


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize("shape", [(2, 5), (), (1,), (1, 1, 3)])
def test_actions_of_any_shape_are_flat_actuators(shape, num_envs):
    env = env_with_space(spaces.Box(-1, 2, shape), num_envs=num_envs, seed=0)
    size = int(np.prod(shape))
    assert env.full_action_spec_unbatched["action"].shape == (size,)
    assert env.action_spec.space.low.unique().item() == -1
    assert env.action_spec.space.high.unique().item() == 2
    check_env_specs(env, seed=0)
    td = env.rand_step(env.reset())
    assert torch.equal(td["next", "observation"], td["action"])  # in C order
    assert actuator_names(env) == [f"actuator_{i}" for i in range(size)]


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (box([-np.inf, -1], [np.inf, 1]), r"actuator 0 of 2 has no bounds \(\[-inf, inf\]\)"),
        (box([-1, 0], [1, np.inf]), "actuator 1 of 2 has no bounds"),
        (box([-1, -1e10], [1, 1e10]), r"actuator 1 of 2 has no bounds \(\[-1e\+10, 1e\+10\]\)"),
        (box([[-1, -1], [-1, 3]], [[1, 1], [1, 3]]), "actuator 3 of 4 has no room between its"),
        (spaces.Box(-1, 1, (0,)), "has no actuators"),
        (spaces.Discrete(3), r"action space Discrete\(3\)"),
        (spaces.MultiBinary(3), "action space MultiBinary"),
        (spaces.Dict(arm=spaces.Box(-1, 1, (2,))), "action space Dict"),
        (spaces.Tuple([spaces.Box(-1, 1, (2,))]), "action space Tuple"),
        (spaces.Box(0, 5, (2,), np.int64), "a task with a Box of real numbers"),
    ],
)
def test_unusable_action_spaces_are_refused_in_one_sentence(space, words):
    with pytest.raises(ValueError, match=words) as caught:
        env_with_space(space)
    assert TAKES in str(caught.value) and "\n" not in str(caught.value)


def test_bounds_of_a_million_are_accepted():
    assert env_with_space(box([-1e6], [1e6])).action_spec.space.high.item() == 1e6


def test_unbounded_dm_control_motors_are_refused():
    with pytest.raises(ValueError, match="lqr-lqr_2_1: actuator 0 of 1 has no bounds"):
        make_env("lqr-lqr_2_1")


def test_unbounded_env_is_accepted_with_transform_action():
    def bounded():
        space = spaces.Box(-1, 1, (2,))
        inner = Takes(spaces.Box(-np.inf, np.inf, (2,)))
        return gym.wrappers.TransformAction(inner, lambda action: action, space)

    gym.register("torchrl_etl_test/Bounded-v0", entry_point=bounded, max_episode_steps=5)
    env = make_env("torchrl_etl_test/Bounded-v0", seed=0)
    assert env.action_spec.space.high.tolist() == [1, 1]
    assert env.rollout(2).shape == (2,)
