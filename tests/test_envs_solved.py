"""``solved``: what environments say of success, under any name and at any step of an episode."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import step_mdp

from tests.planted_env import PLANTED
from torchrl_etl.envs import make_env, resolve_task
from torchrl_etl.training.evaluation import evaluate


class Ends(gym.Env):
    """Ends at its fourth step, and tells of its success in that step's ``info`` only."""

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, solved=(4,), key="is_success"):
        self.solved, self.key = solved, key

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        last = self.count == 4
        info = {self.key: self.count in self.solved} if last or len(self.solved) > 1 else {}
        return np.zeros(1, np.float32), 1.0, last, False, info


gym.register("torchrl_etl_test/Ends-v0", entry_point=Ends, max_episode_steps=9)
ENDS = "torchrl_etl_test/Ends-v0"


def share_solved(env, solved_steps, **options):
    """Of evaluation episodes with actions of zero."""
    still = TensorDictModule(torch.zeros_like, in_keys=["observation"], out_keys=["action"])
    return evaluate(still, env, episodes=2, max_steps=9, solved_steps=solved_steps, **options)


@pytest.mark.parametrize("key", ["solved", "is_success", "success"])
def test_success_of_any_usual_name_becomes_solved(key):
    env = make_env(PLANTED, env_kwargs={"key": key})
    assert env.rollout(3)["next", "solved"].flatten().tolist() == [False, True, True]


def test_no_solved_without_success():
    assert "solved" not in make_env(PLANTED, env_kwargs={"key": None}).reset()


def test_success_in_the_last_info_alone_is_seen_and_an_episode_that_ends_with_it_counts():
    env = make_env(ENDS)
    assert env.rollout(9)["next", "solved"].flatten().tolist() == [False, False, False, True]
    measured = share_solved(env, resolve_task(ENDS).solved_steps)
    assert measured.successes == [True, True] and measured.solved.mean == 1
    assert measured.solved_steps == [1, 1] and measured.lengths == [4, 4]


def test_without_a_threshold_success_that_is_lost_again_does_not_count():
    env = make_env(ENDS, env_kwargs={"solved": (1, 2, 3)})
    assert share_solved(env, None).successes == [False, False]
    assert share_solved(env, 3).successes == [True, True]
    assert share_solved(env, 4).successes == [False, False]


def test_a_threshold_counts_steps_of_the_simulator_however_long_an_action_lasts():
    env = make_env(ENDS, action_repeat=2, env_kwargs={"solved": (1, 2, 3, 4)})
    assert share_solved(env, 4, action_repeat=2).successes == [True, True]
    assert share_solved(env, 5, action_repeat=2).successes == [False, False]


@pytest.mark.parametrize("num_envs", [1, 2])
def test_the_entry_that_means_success_can_be_named(num_envs):
    env_kwargs = {"key": "arrived"}
    assert "solved" not in make_env(ENDS, env_kwargs=env_kwargs).reset()
    env = make_env(ENDS, num_envs=num_envs, success_key="arrived", env_kwargs=env_kwargs)
    assert env.rollout(4)["next", "solved"][..., -1, :].all()


@pytest.mark.filterwarnings("error")
def test_a_name_that_info_never_has_is_told_at_the_end_of_the_first_episode():
    env = make_env(ENDS, success_key="arived", env_kwargs={"key": "arrived"})
    env.rollout(3)
    with pytest.raises(RuntimeWarning, match=r"success_key is 'arived', .*it has arrived"):
        env.rollout(4)
    env.rollout(4)  # once


@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("myoHandPose", 6),
        ("myoElbowPose1D6MRandom-v0", 6),
        ("myoChallengeChaseTagP1-v0", 1),
        ("myoFatiChallengeSoccerP2-v0", 1),
        ("myoChallengeTableTennisP1-v0", 1),
        ("Pendulum-v1", None),
        ("cheetah-run", None),
        (ENDS, None),
    ],
)
def test_only_tasks_that_define_a_threshold_of_solved_steps_have_one(name, steps):
    assert resolve_task(name).solved_steps == steps


def test_partial_reset_keeps_solved_of_the_others_true():
    env = make_env(PLANTED, num_envs=2)
    td = env.rollout(2, break_when_any_done=False)[:, -1]
    assert td["next", "solved"].all()
    after = env.reset(step_mdp(td).set("_reset", torch.tensor([[True], [False]])))
    assert after["solved"].flatten().tolist() == [False, True]
