"""Every method of conf/method runs from its file, charges what it takes, and goes on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tensordict import TensorDict

from tests.configs import CONF, tiny
from tests.test_training_resume import numbers
from torchrl_etl.training import Experiment, resumed_config
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.methods import PlayStage

METHODS = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
RIVALS = [name for name in METHODS if not name.startswith("etl") and not name.endswith("_paper")]
ELBOW = "env=myoElbowPose1D6MFixed-v0"
BRIEFLY = {
    "dep": ["method.options.dep_frames=64", "method.options.tau=4"],
    "dynsyn": ["method.options.frames=200"],
    "sar": ["method.options.frames=448", "method.options.num_synergies=3"],
    "eme": ["method.options.hidden=[16]"],
}


def config(method: str, run: Path, *overrides: str):
    brief = BRIEFLY.get(method, [])
    return tiny(ELBOW, f"method={method}", "frames=608", f"run_dir='{run}'", *brief, *overrides)


@pytest.mark.parametrize("method", METHODS)
def test_a_file_names_itself_and_makes_stages(method):
    made = tiny(f"method={method}", "run_dir=unused", ELBOW)
    assert made.method.name == method
    synergies = min(made.num_synergies, 6)
    Experiment(tiny(f"method={method}", "run_dir=unused", ELBOW, f"num_synergies={synergies}"))


# What their public code says, in the project's words.
PUBLISHED = {
    "lattice_paper": {
        "method.options.state_dependent": True,
        "method.options.freq": 8,
        "collector.num_envs": 16,
        "collector.frames_per_batch": 128,
        "learn.updates_per_frame": 8 / 128,
        "learn.init_random_frames": 10_000,
        "learn.buffer_size": 300_000,
        "learn.sac.gamma": 0.98,
        "learn.sac.tau": 0.02,
        "learn.sac.normalize_observations": True,
        "learn.actor.hidden": [400, 300],
    },
    "dep_paper": {
        "method.options.dep_frames": 200_000,
        "method.options.normalize": "columns",
        "learn.learning_starts": 200_000,
        "learn.updates_per_frame": 0.03,
        "learn.sac.n_steps": 3,
        "learn.actor.hidden": [1024, 1024],
        "learn.critic.hidden": [1024, 1024],
    },
    "eme_paper": {"method.options.weight": 1.0, "method.options.normalize": False},
}


@pytest.mark.parametrize("method", PUBLISHED)
def test_presets_of_papers_have_the_published_numbers(method):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        made = compose("config", overrides=[f"method={method}"])
    values = {key: OmegaConf.select(made, key) for key in PUBLISHED[method]}
    assert values == PUBLISHED[method]


@pytest.mark.slow
@pytest.mark.parametrize("method", RIVALS)
def test_a_rival_runs_charges_its_frames_and_goes_on_with_the_same_numbers(
    method, tmp_path, monkeypatch
):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    summary = Experiment(config(method, whole)).run()
    assert 608 <= summary["learn"]["frames_charged"] < 608 + 64
    first = {"dynsyn": 200, "sar": 448}.get(method, 0)
    assert summary["learn"]["frames"] == summary["learn"]["frames_charged"] - first
    frames, _ = Experiment(resumed_config(whole), resume=whole).folder.series("learn/eval/return")
    assert frames[0] == first

    save, saved = Checkpoints.save, []

    def save_and_die(self, checkpoint, *, step, **kwargs):
        save(self, checkpoint, step=step, **kwargs)
        saved.append(step)
        raise ZeroDivisionError("as good as killed")

    monkeypatch.setattr(Checkpoints, "save", save_and_die)
    with pytest.raises(ZeroDivisionError):
        Experiment(config(method, broken)).run()
    monkeypatch.undo()
    Experiment(resumed_config(broken), resume=broken).run()
    ours, theirs = numbers(broken), numbers(whole)
    if method == "dep":  # the controller's memory is that of a body, which no checkpoint holds
        assert ours.keys() == theirs.keys()
    else:
        assert ours == theirs
    assert saved


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["dynsyn", "eme", "lattice", "lattice_plain"]
)  # losses or actors of their own
def test_a_rival_compiles(method, tmp_path):
    stage = Experiment(config(method, tmp_path / "run", "compile=true")).learn_stage(None)
    stage.restart_collection()
    stage.collect()
    assert all(value.isfinite().all() for value in stage.update().values())
    stage.close()


def test_eme_measures_with_the_discount_of_its_learner(tmp_path):
    settings = ("method=eme", "learn.sac.gamma=0.83", f"run_dir='{tmp_path}/run'")
    stage = Experiment(tiny(*settings)).learn_stage(None)
    assert stage.metric.gamma == 0.83
    assert stage.sac.value_estimator.gamma.item() == pytest.approx(0.83)


def test_eme_saves_the_units_of_its_bonus(tmp_path):
    stage = Experiment(tiny("method=eme", f"run_dir='{tmp_path}/run'")).learn_stage(None)
    assert stage.bonus.deviation is not None
    assert stage.parts()["bonus"] is stage.bonus
    assert stage.bonus in list(stage.buffer.transform)


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("eme", "method.options.gamma is none of the options of method=eme .*learn.sac.gamma"),
        ("lattice", "method.options.gamma is none of the options of method=lattice"),
        ("sac", "method.options.gamma is none of the options of method=sac .it has none"),
        ("sar", "method.options.gamma is none of the options of method=sar"),
    ],
)
def test_options_that_a_method_does_not_have_are_refused(method, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Experiment(
            tiny(f"method={method}", "+method.options.gamma=0.99", f"run_dir='{tmp_path}/run'")
        )


@pytest.mark.parametrize(("starts", "expected"), [(100, 640), (1000, 1000)])
def test_dep_learns_from_when_it_has_acted_alone(starts, expected, tmp_path):
    settings = ("method.options.dep_frames=640", f"learn.learning_starts={starts}")
    workers = ("collector=process", "collector.num_workers=2", "action_repeat=2")
    run = config("dep", tmp_path / "run", *workers, *settings, "collector.frames_per_batch=32")
    stage = Experiment(run).learn_stage(None)
    assert stage.learning_starts == expected
    assert stage.controller.dep_frames == 640 // 2 // 2  # actions of each worker


@pytest.mark.slow
def test_dep_counts_its_actions_before_and_after_episodes_begin_anew(tmp_path):
    stage = Experiment(config("dep", tmp_path / "run", "action_repeat=2")).learn_stage(None)
    stage.restart_collection()
    actions = stage.collect().numel()
    assert stage.frames == 2 * actions and stage.controller.frames == actions
    stage.restart_collection()
    assert stage.controller.frames == actions
    stage.close()


def test_dynsyn_learns_on_the_groups_that_it_found(tmp_path):
    experiment = Experiment(config("dynsyn", tmp_path / "run"))
    groups = experiment.run()["groups"]
    assert groups == json.loads((tmp_path / "run" / "muscle_groups.json").read_text())
    stage = experiment.learned()
    observation = torch.randn(50, stage.observation_dim)
    action = stage.actor(TensorDict({"observation": observation}, [50]))["action"]
    for group in set(groups):
        members = action[:, [i for i, g in enumerate(groups) if g == group]]
        assert (members == members[:, :1]).all()
    assert stage.sac.target_entropy == -len(set(groups))


def test_play_keeps_the_steps_of_whole_episodes_with_their_returns():
    done = torch.tensor([False, True, False, False, True])
    episodes = torch.tensor([3, 3, 5, 7, 7])
    so_far = torch.tensor([1.0, 4.0, 9.0, 2.0, 6.0])
    following = {"done": done, "episode_reward": so_far, "activation": torch.eye(5)}
    rows = TensorDict({"collector": {"traj_ids": episodes}, "next": following}, [5])
    found = PlayStage.finished_episodes(rows)
    assert found["episodes"].tolist() == [3, 3, 7, 7]
    assert found["returns"].tolist() == [4.0, 4.0, 6.0, 6.0]
    assert torch.equal(found["actions"], torch.eye(5)[[0, 1, 3, 4]])


def test_sar_asks_for_whole_episodes_before_it_begins(tmp_path):
    with pytest.raises(ValueError, match=r"need 400 for an episode of 100 steps each"):
        Experiment(config("sar", tmp_path / "run", "method.options.frames=300"))


def test_a_rival_has_no_stage_to_choose_and_no_synergies_to_take(tmp_path):
    for override in ("stage=learn", "synergies=somewhere"):
        with pytest.raises(ValueError, match="method=sac has one stage and no synergies"):
            Experiment(tiny("method=sac", override, f"run_dir='{tmp_path}/run'"))
