"""Names of tasks: what they resolve to, and what is suggested for an unknown one."""

import subprocess
import sys

import gymnasium as gym
import pytest
import torch

from torchrl_etl.envs import episode_length, list_tasks, make_env, resolve_task

PAPER = {
    "myoHandPose": "myoHandPoseFixed-v0",
    "myoHandKeyTurn": "myoHandKeyTurnFixed-v0",
    "myoHandPenTwirl": "myoHandPenTwirlFixed-v0",
    "myoBaoding": "myoChallengeBaodingP1-v1",
    "myoDieReorient": "myoChallengeDieReorientP1-v0",
    "myoRelocate": "myoChallengeRelocateP1-v0",
    "myoLegWalk": "myoLegWalk-v0",
    "myoLegStairTerrainWalk": "myoLegStairTerrainWalk-v0",
    "humanoid-stand": "humanoid-stand",
    "humanoid-walk": "humanoid-walk",
    "humanoid-run": "humanoid-run",
    "dog-walk": "dog-walk",
    "dog-run": "dog-run",
}


def test_the_papers_thirteen_tasks_resolve():
    assert {task.name: resolve_task(task.name).env_id for task in list_tasks()} == PAPER


def test_ids_and_lengths_are_those_of_the_suites():
    import myosuite  # noqa: F401
    from dm_control import suite

    for task in list_tasks():
        if task.suite == "dm_control":
            assert tuple(task.id.split("-")) in suite.ALL_TASKS
        else:
            for env_id in filter(None, (task.id, task.random_id)):
                assert gym.spec(env_id).max_episode_steps == task.episode_steps


@pytest.mark.parametrize("name", ["myoHandPose", "myoHandKeyTurn", "myoHandPenTwirl"])
def test_random_goal_picks_the_random_id(name):
    assert resolve_task(name, "random").env_id == f"{name}Random-v0"
    assert resolve_task(f"{name}Random-v0") == resolve_task(name, "random")


def test_random_goal_of_a_task_without_one_names_those_that_have_it():
    with pytest.raises(ValueError, match=r"dog-run has no random goal.*myoHandKeyTurn"):
        resolve_task("dog-run", "random")
    with pytest.raises(ValueError, match="Pendulum-v1 has no random goal"):
        resolve_task("Pendulum-v1", "random")


def test_goal_that_contradicts_the_id_is_refused():
    with pytest.raises(ValueError, match="leave goal out, or pass the task 'myoHandPose'"):
        resolve_task("myoHandPoseRandom-v0", "fixed")


def test_unknown_goal_is_refused():
    with pytest.raises(ValueError, match="goal is 'moving'; choose one of fixed, random"):
        resolve_task("myoHandPose", "moving")


@pytest.mark.parametrize(
    "wrong, right",
    [
        ("myoHandPenTwril", "myoHandPenTwirl"),
        ("MYOBAODING", "myoBaoding"),
        ("humanoid-stnad", "humanoid-stand"),
        ("cheetah-rnu", "cheetah-run"),
        ("Pendulm-v1", "Pendulum-v1"),
        ("myoHandPoseRandom-v1", "myoHandPoseRandom-v0"),
    ],
)
def test_unknown_task_suggests_the_nearest_name(wrong, right):
    with pytest.raises(ValueError, match=f"Unknown task '{wrong}'; .* {right}[,.;]"):
        resolve_task(wrong)


def test_a_wrong_name_needs_no_simulator_to_be_corrected(monkeypatch):
    for name in ("myosuite", "dm_control"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ValueError, match=r"Unknown task 'overactuatd'; .* overactuated[,.;]"):
        resolve_task("overactuatd")
    with pytest.raises(ImportError, match=r"torchrl_etl\[myosuite\]"):
        resolve_task("somethingOfMyoSuite-v0")


def test_other_suites_are_accepted_by_name():
    assert resolve_task("cheetah-run").suite == "dm_control"
    assert resolve_task("Pendulum-v1").episode_steps == 200
    assert resolve_task("myoElbowPose1D6MRandom-v0").episode_steps == 100


def test_episode_length():
    assert episode_length("myoHandPenTwirl") == 50
    assert episode_length("cheetah-run") == 1000
    assert episode_length("myoHandKeyTurn", "random") == 200


@pytest.mark.slow
def test_paper_names_resolve_without_importing_a_simulator():
    code = (
        "import sys; from torchrl_etl.envs import list_tasks, resolve_task\n"
        "[resolve_task(t.name) for t in list_tasks()]\n"
        "sys.exit(any(m in sys.modules for m in ('myosuite', 'dm_control')))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "random_actions_drop"),
    [("myoBaoding", True), ("myoDieReorient", True), ("myoRelocate", False)],
)
def test_dropping_the_object_does_not_end_full_episodes(name, random_actions_drop):
    torch.manual_seed(0)
    full = make_env(f"{name}Full", seed=0).rollout(1000)
    ends = full["next", "done"].squeeze(-1).nonzero().flatten().tolist()
    assert ends == [episode_length(name) - 1] and not full["next", "terminated"].any()
    assert full["next", "truncated"][-1]
    torch.manual_seed(0)
    early = make_env(name, seed=0).rollout(1000)
    steps = len(early)
    assert (steps < len(full)) == random_actions_drop
    # Up to the early end both are the same.
    torch.testing.assert_close(full["next", "observation"][:steps], early["next", "observation"])
    torch.testing.assert_close(full["next", "reward"][:steps], early["next", "reward"])


def test_full_tasks_are_not_listed_and_keep_the_ids_meaning():
    assert resolve_task("myoBaodingFull").env_id == resolve_task("myoBaoding").env_id
    assert resolve_task("myoChallengeBaodingP1-v1").ends_early
    assert not any(task.name.endswith("Full") for task in list_tasks())
