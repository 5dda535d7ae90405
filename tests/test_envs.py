"""make_env on real MyoSuite and DMControl simulators: specs, seeds, goals, ends of episodes."""

import re
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import DMControlEnv, ParallelEnv, SerialEnv, check_env_specs, step_mdp

from tests.planted_env import PLANTED
from torchrl_etl.envs import actuator_names, episode_length, list_tasks, make_env

TASKS = ["overactuated", "myoHandPenTwirl", "myoLegWalk", "humanoid-stand"]
NAMES = [task.name for task in list_tasks()]


def replay(env, seed, actions):
    """The reset with a seed and the steps of the given actions, as tensordicts."""
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
def test_env_specs_are_valid(name, num_envs):
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
def test_action_bounds_equal_the_simulators(name, low, actuators):
    space = make_env(name).action_spec.space
    assert torch.equal(space.low, torch.full((actuators,), float(low)))
    assert torch.equal(space.high, torch.ones(actuators))


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize(
    "name", ["myoHandPose", "myoHandPenTwirl", "humanoid-stand", "overactuated"]
)
def test_reseeded_env_equals_a_fresh_one(name, num_envs):
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


def test_seed_argument_equals_set_seed():
    first, second = make_env("overactuated", seed=5), make_env("overactuated")
    second.set_seed(5)
    assert torch.equal(first.reset()["observation"], second.reset()["observation"])


def test_batched_envs_have_distinct_seeds_the_first_that_of_a_single_env():
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
    # A relaxed hand keeps the pen; a clenched one throws it out.
    rollout = make_env("myoHandPenTwirl", seed=0).rollout(
        60, lambda td: td.set("action", torch.full((39,), excitation))
    )
    assert len(rollout) == length
    assert rollout["next", "terminated"][-1].item() == dropped
    assert rollout["next", "truncated"][-1].item() != dropped
    assert not rollout["next", "done"][:-1].any()


@pytest.mark.parametrize("num_envs", [1, 2])
def test_action_repeat_sums_rewards_within_the_episode(num_envs):
    """Steps of the simulator: reward 1 each, solved from the second on, at most four."""
    env = make_env(PLANTED, num_envs=num_envs, action_repeat=3, seed=0)
    check_env_specs(env, seed=0)
    rollout = env.rollout(9)["next"].reshape(-1, 2)
    for following in rollout:
        assert following["reward"].flatten().tolist() == [3, 1]
        assert following["observation"][:, 0].tolist() == [3, 4]
        assert following["solved"].all()
        assert following["truncated"].flatten().tolist() == [False, True]


def test_action_repeat_equals_repeating_the_action():
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


def test_batched_reset_takes_a_tensordict_without_mask():
    env = make_env("overactuated", num_envs=2, seed=0)
    td = env.reset(TensorDict({"direction": torch.ones(2, 3)}, batch_size=[2]))
    assert td["observation"].shape == (2, 6)


def test_actuator_names_of_torchrls_dm_control_env_but_not_of_workers():
    reacher = DMControlEnv("reacher", "easy")
    assert actuator_names(reacher) == ["shoulder", "wrist"]
    with pytest.raises(ValueError, match="A SerialEnv runs its simulators in workers; pass the"):
        actuator_names(SerialEnv(2, lambda: reacher))


def test_discrete_actions_are_refused():
    with pytest.raises(ValueError, match="CartPole-v1 has the action space Discrete"):
        make_env("CartPole-v1")


@pytest.mark.parametrize("num_envs", [0, -1, 1.5])
def test_a_wrong_number_of_envs_is_refused(num_envs):
    with pytest.raises(ValueError, match=r"num_envs is .*; it must be a whole number, 1 or more"):
        make_env("overactuated", num_envs=num_envs)


def test_wrong_action_repeat_is_refused():
    with pytest.raises(ValueError, match="action_repeat is 0; it must be a whole number"):
        make_env("overactuated", action_repeat=0)
    with pytest.raises(ValueError, match=r"action_repeat is 26, but .* has 25 steps"):
        make_env("overactuated", action_repeat=26)
    assert make_env("overactuated", action_repeat=25).rollout(3).shape == (1,)


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
def test_spawned_workers_register_the_task():
    env = ParallelEnv(2, _pen, mp_start_method="spawn")
    try:
        assert env.rollout(2)["next", "solved"].shape == (2, 2, 1)
    finally:
        env.close()
