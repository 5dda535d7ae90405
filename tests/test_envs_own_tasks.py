"""Tasks that a user registers: found by module in every process, or refused in one sentence."""

from __future__ import annotations

import json
import sys

import gymnasium as gym
import pytest
import torch

from tests.commands import command, process
from tests.configs import TINY
from torchrl_etl.envs import actuator_names, make_env, resolve_task

SMALL = [*(setting for setting in TINY if not setting.startswith("env=")), "method=sac"]
REACH = """
import gymnasium as gym
import numpy as np


class Reach(gym.Env):
    observation_space = gym.spaces.Box(-10, 10, (2,))
    action_space = gym.spaces.Box(-1, 1, (4,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(-1, 1, 2)
        return self.at.astype(np.float32), {}

    def step(self, action):
        self.at = np.clip(self.at + 0.1 * (action[:2] - action[2:]), -10, 10)
        near = bool(np.abs(self.at).max() < 0.2)
        return self.at.astype(np.float32), -np.abs(self.at).sum(), near, False, {"arrived": near}


gym.register("%s", entry_point=Reach, max_episode_steps=20)
"""


@pytest.fixture
def own_task(tmp_path, monkeypatch) -> str:
    """The id of a task whose module lies in the current folder and not on the path."""
    module, env_id = f"own_{tmp_path.name.replace('-', '_')}", "Reach-v0"
    (tmp_path / f"{module}.py").write_text(REACH % env_id)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield f"{module}:{env_id}"
    gym.registry.pop(env_id, None)
    sys.modules.pop(module, None)


def test_a_module_in_the_current_folder_registers_its_task(own_task):
    task = resolve_task(own_task)
    assert (task.name, task.env_id, task.episode_steps) == (own_task, "Reach-v0", 20)
    assert task.goal is None and task.solved_steps is None
    env = make_env(own_task, num_envs=2, seed=0)
    assert env.rollout(3)["action"].shape == (2, 3, 4)
    assert actuator_names(own_task) == [f"actuator_{i}" for i in range(4)]


def test_id_not_registered_by_the_module_is_refused(own_task):
    module = own_task.partition(":")[0]
    with pytest.raises(ValueError, match=f"Importing '{module}' registers no task 'Raech-v0'"):
        resolve_task(f"{module}:Raech-v0")


@pytest.mark.parametrize("module", ["no_such_module", "os.no_such", ".relative"])
def test_missing_module_is_refused(module):
    with pytest.raises(ImportError, match=f"There is no module '{module}' for the task"):
        resolve_task(f"{module}:Reach-v0")


def test_import_error_within_the_module_is_passed_on(tmp_path, monkeypatch):
    (tmp_path / "needs_more.py").write_text("import not_installed_at_all")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="No module named 'not_installed_at_all'"):
        resolve_task("needs_more:Reach-v0")


@pytest.mark.slow
def test_recipe_trains_and_evaluates_a_users_task(own_task, tmp_path):
    run = f"run_dir='{tmp_path}/run'"
    assert command("etl_sac.py", *SMALL, f"env={own_task}", "success_key=arrived", run) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["env"] == own_task and summary["goal"] is None
    assert 0 <= summary["learn"]["solved"]["after"] <= 1
    assert command("evaluate.py", f"run='{tmp_path}/run'", "episodes=1") == 0


@pytest.mark.slow
def test_users_task_is_found_by_workers_but_not_from_another_folder(own_task, tmp_path):
    settings = ("collector=process", "success_key=arrived", f"run_dir='{tmp_path}/run'")
    done = process("etl_sac.py", *SMALL, f"env={own_task}", *settings, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (elsewhere := tmp_path / "elsewhere").mkdir()
    done = process("evaluate.py", f"run='{tmp_path}/run'", "episodes=1", cwd=elsewhere)
    assert done.returncode != 0 and "Traceback" not in done.stderr
    assert "There is no module" in done.stderr


@pytest.mark.parametrize(
    ("name", "goal"),
    [
        ("myoElbowPose1D6MRandom-v0", "random"),
        ("myoElbowPose1D6MFixed-v0", "fixed"),
        ("myoHandPoseRandom-v0", "random"),
        ("Pendulum-v1", None),
        ("myoHandPose", "fixed"),
    ],
)
def test_goal_is_read_from_the_id(name, goal):
    task = resolve_task(name)
    assert task.goal == goal
    assert task.goal_in_words == (f" ({goal} goal)" if goal else "")


def test_goal_that_contradicts_the_id_is_refused():
    with pytest.raises(ValueError, match="already has the random goal"):
        resolve_task("myoElbowPose1D6MRandom-v0", "fixed")


@pytest.mark.parametrize("name", ["cheetah-run", "Pendulum-v1", "myoElbowPose1D6MRandom-v0"])
def test_unseeded_environments_start_in_different_states(name):
    first, second = make_env(name, num_envs=2).reset()["observation"]
    alone = make_env(name).reset()["observation"]
    assert not torch.equal(first, second)
    assert not torch.equal(first, alone)


def test_actuator_names_leave_out_motors_that_actions_do_not_drive():
    names = actuator_names("myoChallengeOslRunFixed-v0")  # 54 muscles, 2 motors of a prosthesis
    assert len(names) == len(set(names)) == 54
    assert not [name for name in names if "osl" in name.lower()]
    assert all(type(name) is str for name in names)
