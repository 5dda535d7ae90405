"""Non-finite numbers stop a run with an error that says where they came from."""

import numpy as np
import pytest
import torch

from tests.planted_env import PLANTED, Planted
from torchrl_etl.envs import SimulationError, make_env


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize(
    "fault, words",
    [
        ("observation", "observation is not finite (entries 1 of 3) at step 3 of episode 1"),
        ("overflow", "observation is not finite (entries 2 of 3) at step 3"),
        ("reward", "reward is not finite at step 3 of episode 1 (since seed 9)"),
    ],
)
def test_non_finite_numbers_stop_the_run_and_say_where(fault, words, num_envs):
    env = make_env(PLANTED, num_envs=num_envs, env_kwargs={"fault": fault})
    with pytest.raises(SimulationError) as caught:
        env.rollout(4, auto_reset=False, tensordict=env.reset(seed=9))
    assert words in str(caught.value) and PLANTED in str(caught.value)


@pytest.mark.parametrize("num_envs", [1, 2])
def test_observation_of_the_wrong_shape_is_a_simulation_error(num_envs, monkeypatch):
    monkeypatch.setattr(Planted, "reset", lambda self, **_: (np.zeros(2), {}))
    monkeypatch.setattr(Planted, "count", 0, raising=False)
    words = r"observation has shape \(2,\) but its space has \(3,\) at step 0 of episode 1"
    with pytest.raises(SimulationError, match=words):
        make_env(PLANTED, num_envs=num_envs).reset(seed=0)


def test_a_divergence_that_dm_control_reports_is_a_simulation_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs it to a file in the working directory
    env = make_env("humanoid-stand", seed=0)
    td = env.reset()
    env._env.unwrapped.physics.data.qvel[:] = 1e12
    with pytest.raises(SimulationError, match="humanoid-stand: the simulator diverged"):
        env.rand_step(td)


def test_non_finite_action_blames_the_policy():
    env = make_env("myoHandPenTwirl", seed=0)
    action = torch.zeros(39)
    action[5] = float("nan")
    with pytest.raises(SimulationError, match=r"entries 5 of 39.*policy"):
        env.step(env.reset().set("action", action))
