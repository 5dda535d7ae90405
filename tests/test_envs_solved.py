"""``solved``: success from an environment's info, under any key and at any step."""

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
    """Ends at its fourth step, whose info alone has the key unless ``solved`` has several steps."""

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


def evaluate_zero_actions(env, solved_steps, **options):
    """Evaluates a policy whose actions are zero."""
    still = TensorDictModule(torch.zeros_like, in_keys=["observation"], out_keys=["action"])
    return evaluate(still, env, episodes=2, max_steps=9, solved_steps=solved_steps, **options)


@pytest.mark.parametrize("key", ["solved", "is_success", "success"])
def test_usual_success_keys_become_solved(key):
    env = make_env(PLANTED, env_kwargs={"key": key})
    assert env.rollout(3)["next", "solved"].flatten().tolist() == [False, True, True]


def test_env_without_success_has_no_solved_entry():
    assert "solved" not in make_env(PLANTED, env_kwargs={"key": None}).reset()


def test_success_in_the_last_info_only_counts_as_solved():
    env = make_env(ENDS)
    assert env.rollout(9)["next", "solved"].flatten().tolist() == [False, False, False, True]
    measured = evaluate_zero_actions(env, resolve_task(ENDS).solved_steps)
    assert measured.successes == [True, True] and measured.solved.mean == 1
    assert measured.solved_steps == [1, 1] and measured.lengths == [4, 4]


def test_without_a_threshold_lost_success_does_not_count():
    env = make_env(ENDS, env_kwargs={"solved": (1, 2, 3)})
    assert evaluate_zero_actions(env, None).successes == [False, False]
    assert evaluate_zero_actions(env, 3).successes == [True, True]
    assert evaluate_zero_actions(env, 4).successes == [False, False]


def test_threshold_counts_simulator_steps_under_action_repeat():
    env = make_env(ENDS, action_repeat=2, env_kwargs={"solved": (1, 2, 3, 4)})
    assert evaluate_zero_actions(env, 4, action_repeat=2).successes == [True, True]
    assert evaluate_zero_actions(env, 5, action_repeat=2).successes == [False, False]


@pytest.mark.parametrize("num_envs", [1, 2])
def test_success_key_names_the_info_entry(num_envs):
    env_kwargs = {"key": "arrived"}
    assert "solved" not in make_env(ENDS, env_kwargs=env_kwargs).reset()
    env = make_env(ENDS, num_envs=num_envs, success_key="arrived", env_kwargs=env_kwargs)
    assert env.rollout(4)["next", "solved"][..., -1, :].all()


@pytest.mark.filterwarnings("error")
def test_success_key_missing_from_info_warns_after_the_first_episode():
    env = make_env(ENDS, success_key="arived", env_kwargs={"key": "arrived"})
    env.rollout(3)
    with pytest.raises(RuntimeWarning, match=r"success_key is 'arived', .*it has arrived"):
        env.rollout(4)
    env.rollout(4)  # it warns only once


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
def test_solved_steps_of_tasks_with_and_without_a_threshold(name, steps):
    assert resolve_task(name).solved_steps == steps


def test_partial_reset_keeps_solved_of_the_others_true():
    env = make_env(PLANTED, num_envs=2)
    td = env.rollout(2, break_when_any_done=False)[:, -1]
    assert td["next", "solved"].all()
    after = env.reset(step_mdp(td).set("_reset", torch.tensor([[True], [False]])))
    assert after["solved"].flatten().tolist() == [False, True]
