"""The factory: what reaches the tensordict, from real MyoSuite and DMControl simulators."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import ParallelEnv, check_env_specs, step_mdp

from torchrl_etl.envs import (
    SimulationError,
    actuator_names,
    episode_length,
    list_tasks,
    make_env,
    resolve_task,
)
from torchrl_etl.training.evaluation import evaluate

TASKS = ["overactuated", "myoHandPenTwirl", "myoLegWalk", "humanoid-stand"]
NAMES = [task.name for task in list_tasks()]


class Planted(gym.Env):
    """Counts its steps, reports success under ``key``, and breaks as told."""

    def __init__(self, fault="none", key="is_success", discrete=False):
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float64)
        if discrete:
            self.action_space = gym.spaces.Discrete(2)
        self.fault, self.key = fault, key

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(3), {}

    def step(self, action):
        self.count += 1
        broken = self.count == 3
        observation = np.full(3, float(self.count))
        if broken and self.fault == "observation":
            observation[1] = np.nan
        if broken and self.fault == "overflow":
            observation[2] = 1e300
        reward = float("inf") if broken and self.fault == "reward" else 1.0
        info = {self.key: self.count >= 2} if self.key else {}
        return observation, reward, self.count == 5, False, info


gym.register("torchrl_etl_test/Planted-v0", entry_point=Planted, max_episode_steps=4)
PLANTED = "torchrl_etl_test/Planted-v0"


def replay(env, seed, actions):
    """Resets with a seed, and returns what each step of the given actions produced."""
    env.set_seed(seed)
    td = env.reset()
    seen = [td]
    for action in actions:
        result = env.step(td.set("action", action))["next"]
        seen.append(result)
        if result["done"].any():
            break
        td = result.exclude("reward")
    return seen


def assert_identical(first, second):
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        assert (a == b).all()


def some_actions(env, steps):
    generator = torch.Generator().manual_seed(3)
    low, high = env.action_spec.space.low, env.action_spec.space.high
    return [low + (high - low) * torch.rand(low.shape, generator=generator) for _ in range(steps)]


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize("name", TASKS)
def test_specs_hold(name, num_envs):
    env = make_env(name, num_envs=num_envs, seed=0)
    check_env_specs(env, seed=0)
    td = env.rand_step(env.reset())
    batch = () if num_envs == 1 else (num_envs,)
    assert env.batch_size == batch
    assert td["observation"].dtype == td["action"].dtype == torch.float32
    assert td["next", "reward"].shape == (*batch, 1)
    if name == "humanoid-stand":
        assert "solved" not in td["next"]
    else:
        assert td["next", "solved"].shape == (*batch, 1)
        assert td["solved"].dtype == td["next", "solved"].dtype == torch.bool
        assert not td["solved"].any()
        assert "solved" in env.observation_spec


@pytest.mark.parametrize(
    "name, low, actuators",
    [("myoHandPenTwirl", -1, 39), ("myoLegWalk", 0, 80), ("humanoid-stand", -1, 21)],
)
def test_bounds_are_the_simulators(name, low, actuators):
    space = make_env(name).action_spec.space
    assert torch.equal(space.low, torch.full((actuators,), float(low)))
    assert torch.equal(space.high, torch.ones(actuators))


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize(
    "name", ["myoHandPose", "myoHandPenTwirl", "humanoid-stand", "overactuated"]
)
def test_used_then_reseeded_equals_fresh(name, num_envs):
    goal = "fixed" if name == "humanoid-stand" else "random"
    used = make_env(name, num_envs=num_envs, goal=goal, seed=1)
    actions = some_actions(used, 15)
    for seed in (2, 3):
        replay(used, seed, actions)
    fresh = make_env(name, num_envs=num_envs, goal=goal)
    assert_identical(replay(used, 7, actions), replay(fresh, 7, actions))
    first, other = replay(used, 7, actions), replay(used, 8, actions)
    assert not (first[0] == other[0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_paper_task_builds_as_listed_and_reseeds_exactly(name):
    task = next(task for task in list_tasks() if task.name == name)
    used, fresh = make_env(name, seed=0), make_env(name)
    actions = some_actions(used, 60)
    replay(used, 2, actions)
    first = replay(used, 7, actions)
    assert_identical(first, replay(fresh, 7, actions))
    assert ("solved" in first[0]) == task.solved
    inner = used._env
    limit = inner.spec.max_episode_steps if inner.spec else inner.unwrapped._step_limit
    assert limit == task.episode_steps
    assert len(actuator_names(used)) == used.action_spec.shape[-1]


def test_seed_argument_is_set_seed():
    first, second = make_env("overactuated", seed=5), make_env("overactuated")
    second.set_seed(5)
    assert torch.equal(first.reset()["observation"], second.reset()["observation"])


def test_each_copy_has_its_own_seed_and_the_first_repeats_a_single_env():
    single = make_env("myoHandPose", goal="random", seed=4).reset()
    batch = make_env("myoHandPose", goal="random", num_envs=3, seed=4).reset()
    later = make_env("myoHandPose", goal="random", num_envs=3, seed=5).reset()
    rows = torch.cat([batch["observation"], later["observation"]])
    assert torch.equal(batch["observation"][0], single["observation"])
    assert len(torch.unique(rows, dim=0)) == 6


def test_random_goal_changes_between_episodes_and_the_fixed_one_does_not():
    for goal, varies in (("fixed", False), ("random", True)):
        env = make_env("myoHandPose", goal=goal, seed=0)
        starts = {tuple(env.reset()["observation"].tolist()) for _ in range(3)}
        assert (len(starts) > 1) == varies


@pytest.mark.parametrize("excitation, length, dropped", [(-1.0, 50, False), (1.0, 13, True)])
def test_pen_twirl_truncates_at_its_limit_and_terminates_on_a_drop(excitation, length, dropped):
    # A relaxed hand keeps the pen lying there; one that clenches throws it out.
    rollout = make_env("myoHandPenTwirl", seed=0).rollout(
        60, lambda td: td.set("action", torch.full((39,), excitation))
    )
    assert len(rollout) == length
    assert rollout["next", "terminated"][-1].item() == dropped
    assert rollout["next", "truncated"][-1].item() != dropped
    assert not rollout["next", "done"][:-1].any()


@pytest.mark.parametrize("num_envs", [1, 2])
def test_a_repeated_action_adds_up_its_rewards_within_the_episode(num_envs):
    """Each step pays 1, is solved from the second on, and the limit is four of the simulator's."""
    env = make_env(PLANTED, num_envs=num_envs, action_repeat=3, seed=0)
    check_env_specs(env, seed=0)
    rollout = env.rollout(9)["next"].reshape(-1, 2)
    for following in rollout:
        assert following["reward"].flatten().tolist() == [3, 1]
        assert following["observation"][:, 0].tolist() == [3, 4]
        assert following["solved"].all()
        assert following["truncated"].flatten().tolist() == [False, True]


def test_a_repeated_action_is_the_same_action_twice():
    once, twice = make_env("myoHandPose", seed=0), make_env("myoHandPose", action_repeat=2, seed=0)
    actions = some_actions(once, 4)
    single = replay(once, 5, [action for action in actions for _ in range(2)])
    double = replay(twice, 5, actions)
    assert_identical(
        [step["observation"] for step in single[::2]], [x["observation"] for x in double]
    )
    rewards = [a["reward"] + b["reward"] for a, b in zip(single[1::2], single[2::2], strict=True)]
    torch.testing.assert_close(rewards, [step["reward"] for step in double[1:]])


@pytest.mark.slow
def test_time_limit_of_dm_control_truncates():
    rollout = make_env("humanoid-stand", seed=0).rollout(1001)
    assert rollout.shape == (1000,)
    assert rollout["next", "truncated"][-1].item()
    assert not rollout["next", "terminated"].any()


def test_partial_reset_leaves_the_others_alone():
    env = make_env("myoHandPenTwirl", num_envs=2, seed=0)
    td = env.rollout(3, break_when_any_done=False)[:, -1]
    before = step_mdp(td)
    mask = torch.tensor([[True], [False]])
    after = env.reset(before.clone().set("_reset", mask))
    assert not torch.equal(after["observation"][0], before["observation"][0])
    assert torch.equal(after["observation"][1], before["observation"][1])
    assert not after["solved"][0].item()


def test_partial_reset_keeps_solved_of_the_others_true():
    env = make_env(PLANTED, num_envs=2)
    td = env.rollout(2, break_when_any_done=False)[:, -1]
    assert td["next", "solved"].all()
    after = env.reset(step_mdp(td).set("_reset", torch.tensor([[True], [False]])))
    assert after["solved"].flatten().tolist() == [False, True]


def test_batched_reset_takes_a_tensordict_without_mask():
    env = make_env("overactuated", num_envs=2, seed=0)
    td = env.reset(TensorDict({"direction": torch.ones(2, 3)}, batch_size=[2]))
    assert td["observation"].shape == (2, 6)


@pytest.mark.parametrize("key", ["solved", "is_success", "success"])
def test_success_of_any_usual_name_becomes_solved(key):
    env = make_env(PLANTED, env_kwargs={"key": key})
    assert env.rollout(3)["next", "solved"].flatten().tolist() == [False, True, True]


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


def test_no_solved_without_success():
    assert "solved" not in make_env(PLANTED, env_kwargs={"key": None}).reset()


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize(
    "fault, says",
    [
        ("observation", "observation is not finite (entries 1 of 3) at step 3 of episode 1"),
        ("overflow", "observation is not finite (entries 2 of 3) at step 3"),
        ("reward", "reward is not finite at step 3 of episode 1 (since seed 9)"),
    ],
)
def test_a_fault_stops_the_run_and_says_where(fault, says, num_envs):
    env = make_env(PLANTED, num_envs=num_envs, env_kwargs={"fault": fault})
    with pytest.raises(SimulationError) as caught:
        env.rollout(4, auto_reset=False, tensordict=env.reset(seed=9))
    assert says in str(caught.value) and PLANTED in str(caught.value)


def test_a_divergence_that_dm_control_reports_is_a_simulation_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs it to a file in the working directory
    env = make_env("humanoid-stand", seed=0)
    td = env.reset()
    env._env.unwrapped.physics.data.qvel[:] = 1e12
    with pytest.raises(SimulationError, match="humanoid-stand: the simulator diverged"):
        env.rand_step(td)


def test_an_action_that_is_not_finite_blames_the_policy():
    env = make_env("myoHandPenTwirl", seed=0)
    action = torch.zeros(39)
    action[5] = float("nan")
    with pytest.raises(SimulationError, match=r"entries 5 of 39.*policy"):
        env.step(env.reset().set("action", action))


def test_discrete_actions_are_refused():
    with pytest.raises(ValueError, match="CartPole-v1 has the action space Discrete"):
        make_env("CartPole-v1")


@pytest.mark.parametrize("num_envs", [0, -1, 1.5])
def test_a_wrong_number_of_envs_is_refused(num_envs):
    with pytest.raises(ValueError, match="num_envs must be a positive integer"):
        make_env("overactuated", num_envs=num_envs)


def test_a_wrong_number_of_repetitions_is_refused():
    with pytest.raises(ValueError, match="action_repeat must be a positive integer, got 0"):
        make_env("overactuated", action_repeat=0)


@pytest.mark.parametrize("num_envs", [1, 2])
def test_held_hand_activation_settles_at_the_action(num_envs):
    env = make_env("myoHandPose", num_envs=num_envs, seed=0, activations=True)
    td = env.reset()
    assert torch.equal(td["activation"], -torch.ones_like(td["activation"]))
    action = torch.linspace(-0.8, 0.8, 39).expand(*env.batch_size, 39)
    for _ in range(60):
        td = env.step(td.set("action", action))["next"].exclude("reward")
    torch.testing.assert_close(td["activation"], action, atol=2e-3, rtol=0)


def test_leg_activation_is_the_simulators_own():
    env = make_env("myoLegWalk", seed=0, activations=True)
    td = env.rand_step(env.reset())
    truth = torch.as_tensor(env._env.unwrapped.data.act, dtype=torch.float32)
    torch.testing.assert_close(td["next", "activation"], truth)
    assert not td["activation"].any() and td["next", "activation"].max() > 0


def test_activation_needs_muscles():
    with pytest.raises(ValueError, match="needs a MyoSuite task"):
        make_env("overactuated", activations=True)


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize("name", ["myoHandPose", "myoLegWalk"])
def test_muscle_length_is_the_simulators_own(name, num_envs):
    env = make_env(name, num_envs=num_envs, seed=0, muscle_lengths=True)
    simulators = [env._env] if num_envs == 1 else env._env.envs

    def check(td):
        lengths = td["muscle_length"].view(num_envs, -1)
        for entry, simulator in zip(lengths, simulators, strict=True):
            model, data = simulator.unwrapped.model, simulator.unwrapped.data
            truth = [data.actuator(model.actuator(i).name).length[0] for i in range(model.nu)]
            assert entry.dtype == torch.float32
            torch.testing.assert_close(entry, torch.tensor(truth, dtype=torch.float32))

    td = env.reset()
    check(td)
    check(env.rand_step(td)["next"])


def test_an_excited_muscle_shortens_its_own_entry():
    env = make_env("myoHandPose", seed=0, muscle_lengths=True)

    def lengths_after(action):
        env.set_seed(0)
        td = env.reset()
        for _ in range(20):
            td = env.step(td.set("action", action))["next"].exclude("reward")
        return td["muscle_length"]

    relaxed = torch.full((39,), -1.0)
    before = lengths_after(relaxed)
    for muscle in (0, 12, 38):
        action = relaxed.clone()
        action[muscle] = 1.0
        assert lengths_after(action)[muscle] < before[muscle] - 1e-3, muscle


def test_muscle_lengths_and_activations_come_together_and_pass_the_specs():
    env = make_env("myoHandPose", num_envs=2, seed=0, activations=True, muscle_lengths=True)
    check_env_specs(env)
    assert env.observation_spec["muscle_length"].shape == (2, 39)


@pytest.mark.parametrize("name", ["overactuated", "humanoid-stand"])
def test_muscle_lengths_need_muscles(name):
    with pytest.raises(ValueError, match="muscle_lengths=True needs a MyoSuite task"):
        make_env(name, muscle_lengths=True)


def test_muscles_of_the_hand_are_the_same_by_name_and_order():
    pose, pen = actuator_names("myoHandPose"), actuator_names("myoHandPenTwirl")
    assert pose == pen and pose[0] == "ECRL" and len(pose) == 39
    assert actuator_names("myoRelocate")[-39:] == pose


def test_legs_keep_their_sides():
    names = actuator_names("myoLegWalk")
    assert {name[-2:] for name in names} == {"_r", "_l"}
    assert names == actuator_names("myoLegStairTerrainWalk")


def test_actuator_names_of_an_environment():
    for num_envs in (1, 2):
        assert actuator_names(make_env("humanoid-stand", num_envs=num_envs))[0] == "abdomen_y"
    without_a_model = make_env(PLANTED)
    count = without_a_model.action_spec.shape[-1]
    assert actuator_names(without_a_model) == [f"actuator_{i}" for i in range(count)]


def test_building_is_silent(capfd, recwarn, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("myoHandPose", "cheetah-run"):
        make_env(name)
        episode_length(name)
    assert capfd.readouterr() == ("", "")
    assert not [w for w in recwarn if "spec" in str(w.message) or "settotal" in str(w.message)]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_table_in_the_docs_is_what_its_code_prints(capsys):
    page = (Path(__file__).parents[1] / "docs" / "tasks.md").read_text()
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL)[1])
    assert capsys.readouterr().out in page


def _pen():
    return make_env("myoHandPenTwirl")


@pytest.mark.slow
def test_worker_processes_register_for_themselves():
    env = ParallelEnv(2, _pen, mp_start_method="spawn")
    try:
        assert env.rollout(2)["next", "solved"].shape == (2, 2, 1)
    finally:
        env.close()
