"""Every method of conf/method: settings, options, charged frames, and resuming."""

from __future__ import annotations

import json

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tensordict import TensorDict

from tests.configs import CONF, ELBOW, rival, tiny
from tests.runs import numbers
from tests.stages import fill, method_stage
from torchrl_etl.baselines import DEPExploration
from torchrl_etl.baselines.dynsyn import DynSynNetwork
from torchrl_etl.envs import EnvironmentSpec, make_env
from torchrl_etl.experiment import Experiment
from torchrl_etl.learners.compiled import compiled
from torchrl_etl.methods import METHODS as CLASSES
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import save_bundle
from torchrl_etl.training import resumed_config, run_alone
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.context import Context
from torchrl_etl.training.loop import StopOnSignal

METHODS = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
RIVALS = [name for name in METHODS if not name.startswith("etl") and not name.endswith("_paper")]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_file_names_itself_and_builds_an_experiment(method, tmp_path):
    made = tiny(f"method={method}", "run_dir=unused", ELBOW)
    assert made.method.name == method
    if made.synergies.bundle is not None:  # made on the body or by a script of studies/
        spec = EnvironmentSpec.of(make_env(made.env))
        bounds = {"low": spec.low.tolist(), "high": spec.high.tolist()}
        decoder = SynergyDecoder(2, spec.action_dim, hidden=(8,), **bounds)
        made.synergies.bundle = str(
            save_bundle(decoder, tmp_path / "bundle", task=made.env, actuators=spec.actuators)
        )
    Experiment(made)


@pytest.mark.parametrize("method", ["sac", "lattice"])
def test_methods_without_synergies_ignore_num_synergies(method):
    for number in ("null", "8"):
        made = tiny(
            f"method={method}", "env=cheetah-run", f"num_synergies={number}", "run_dir=unused"
        )
        Experiment(made).method.stage()


def test_etl_defaults_to_half_the_actuators_of_a_small_body():
    said = []
    made = Experiment(
        tiny("env=cheetah-run", "num_synergies=null", "run_dir=unused"), say=said.append
    )
    assert made.config.num_synergies == 3
    assert said == ["num_synergies is 3, as cheetah-run has 6 actuators."]


def test_etl_defaults_to_eight_synergies_for_a_large_body():
    said = []
    made = Experiment(tiny("num_synergies=null", "run_dir=unused"), say=said.append)
    assert made.config.num_synergies == 8 and not said  # of 16 actuators


def test_etl_refuses_more_synergies_than_actuators():
    with pytest.raises(ValueError, match="num_synergies is 7 but cheetah-run has 6 actuators"):
        Experiment(tiny("env=cheetah-run", "num_synergies=7", "run_dir=unused"))


# Values in the authors' public code, under this project's names of settings.
PUBLISHED = {
    "lattice_paper": {
        "method.options.state_dependent": True,
        "method.options.freq": 8,
        "collector.num_envs": 16,
        "collector.frames_per_batch": 128,
        "learn.replay_ratio": 8 / 128,
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
        "learn.replay_ratio": 0.03,
        "learn.n_steps": 3,
        "learn.actor.hidden": [1024, 1024],
        "learn.critic.hidden": [1024, 1024],
    },
    "eme_paper": {"method.options.weight": 1.0, "method.options.normalize": False},
    "sar_paper": {
        "method.options.num_synergies": 20,
        "method.options.blend": {"legs": 1.0, "hands": 0.66},
        "learn.learning_starts": 5_000,
        "learn.buffer_size": 300_000,
        "learn.sac.gamma": 0.98,
        "learn.sac.tau": 0.02,
        "learn.sac.normalize_observations": True,
    },
}


@pytest.mark.parametrize("method", PUBLISHED)
def test_paper_presets_have_the_published_values(method):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        made = compose("config", overrides=[f"method={method}"])
    values = {key: OmegaConf.select(made, key) for key in PUBLISHED[method]}
    assert values == PUBLISHED[method]


@pytest.mark.parametrize("method", [name for name in METHODS if name.endswith("_paper")])
def test_paper_presets_do_not_scale_rewards(method):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        assert compose("config", overrides=[f"method={method}"]).learn.reward_scale == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("method", RIVALS)
def test_baseline_charges_its_frames_and_resumes_with_the_same_numbers(
    method, tmp_path, monkeypatch
):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    summary = Experiment(rival(method, whole)).run()
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
        Experiment(rival(method, broken)).run()
    monkeypatch.undo()
    Experiment(resumed_config(broken), resume=broken).run()
    ours, theirs = numbers(broken), numbers(whole)
    if method == "dep":  # the memory of DEP belongs to a simulation, which no checkpoint holds
        assert ours.keys() == theirs.keys()
    else:
        assert ours == theirs
    assert saved


@pytest.mark.slow
@pytest.mark.parametrize("method", ["dynsyn", "eme", "lattice", "lattice_plain"])
def test_baseline_losses_and_actors_trace_as_one_graph(method, traced_only):
    stage = method_stage(method)
    fill(stage)
    inputs, gradients = stage.learner.inputs(stage.samples(1))[0], stage.learner.gradients
    stage.close()
    expected, logged, changed = gradients(inputs)
    found, logged_too, changed_too = compiled(gradients)(inputs)
    torch.testing.assert_close((found, changed_too), (expected, changed))
    for key, value in logged.items():
        torch.testing.assert_close(logged_too[key], value)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "lattice learn.noise.kind=held",
            "learn.noise.kind is 'held', but with method=lattice the actor has its own noise; "
            "use learn.noise.kind=independent.",
        ),
        ("dynsyn learn.noise.kind=held", "learn.noise.kind is 'held', but with method=dynsyn the"),
        ("eme learn.n_steps=3", "learn.n_steps is 3, but with method=eme bonus and metric are of"),
    ],
)
def test_setting_that_a_method_ignores_is_refused(setting, message, tmp_path):
    method, override = setting.split()
    with pytest.raises(ValueError) as caught:
        Experiment(tiny(f"method={method}", override, f"run_dir='{tmp_path}/run'"))
    assert str(caught.value).startswith(message)
    assert not (tmp_path / "run").exists()


def test_resume_of_an_older_run_corrects_a_setting_its_method_ignores(tmp_path):
    of_before = tiny("method=lattice", "learn.noise.kind=held")
    assert Experiment(of_before, resume=tmp_path).config.learn.noise.kind == "independent"


@pytest.mark.parametrize("method", METHODS)
def test_method_file_holds_the_fixed_settings_of_its_method(method):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        made = compose("config", overrides=[f"method={method}"])
    for key, value, _ in CLASSES[made.method.kind].fixed_settings:
        assert OmegaConf.select(made, key) == value


@pytest.mark.parametrize(("ratio", "prefill"), [(1, True), (4, True), (0.5, False)])
def test_prefill_is_the_default_at_one_update_per_frame_or_more(ratio, prefill):
    config = Experiment(tiny(f"learn.replay_ratio={ratio}", "run_dir=unused")).config
    assert config.learn.prefill is prefill
    given = tiny(f"learn.replay_ratio={ratio}", f"learn.prefill={not prefill}", "run_dir=unused")
    assert Experiment(given).config.learn.prefill is not prefill


def test_config_without_synergies_has_no_exploration_or_prefill():
    config = Experiment(tiny("method=sac", "learn.prefill=true", "run_dir=unused")).config
    assert (config.exploration.kind, config.synergies.kind, config.learn.prefill) == (
        None,
        None,
        False,
    )


def test_eme_metric_uses_the_discount_of_the_learner(tmp_path):
    settings = ("method=eme", "learn.sac.gamma=0.83", f"run_dir='{tmp_path}/run'")
    objective = Experiment(tiny(*settings)).method.stage().learner.objective
    assert objective.terms[0].loss.gamma == 0.83
    assert objective.sac.value_estimator.gamma.item() == pytest.approx(0.83)


def test_eme_state_dict_holds_the_scale_of_its_bonus(tmp_path):
    stage = Experiment(tiny("method=eme", f"run_dir='{tmp_path}/run'")).method.stage()
    (bonus,) = stage.learner.objective.transforms
    assert bonus.deviation is not None
    assert "transforms.0.deviation.mean" in stage.learner.components["objective"].state_dict()


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("eme", "method.options.gamma is not an option of method=eme .*learn.sac.gamma"),
        ("lattice", "method.options.gamma is not an option of method=lattice"),
        ("sac", "method.options.gamma is not an option of method=sac .it has none"),
        ("sar", "method.options.gamma is not an option of method=sar"),
    ],
)
def test_options_that_a_method_does_not_have_are_refused(method, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Experiment(
            tiny(f"method={method}", "+method.options.gamma=0.99", f"run_dir='{tmp_path}/run'")
        )


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("dep", {}, "method.options lacks dep_frames, which kind=dep needs"),
        ("eme", {"lr": 1e-3, "tau": 0.01}, "method.options lacks embedding_dim, hidden, ensemble"),
        ("sar", {"play_task": None}, "method.options lacks frames, rollout_frames"),
        ("dynsyn", {"frames": 200}, "method.options lacks amplitude, group_share"),
        (
            "dynsyn",
            {"frames": 200, "amplitude": 1.0, "group_share": 0.5, "start_share": 0.5},
            "method.options.start_share needs ceiling",
        ),
    ],
)
def test_missing_options_are_named(kind, options, message, tmp_path):
    config = tiny(f"run_dir='{tmp_path}/run'", "method=sac")
    config.method = {"name": "mine", "kind": kind, "options": options}
    with pytest.raises(ValueError, match=message):
        Experiment(config)


def test_lattice_has_defaults_for_all_its_options(tmp_path):
    config = tiny(f"run_dir='{tmp_path}/run'", "method=sac", "learn.noise.kind=independent")
    config.method = {"name": "mine", "kind": "lattice"}
    assert Experiment(config).method.options == {}
    config.method = {**config.method, "options": {"state_dependent": True}}
    assert Experiment(config).method.stage().learner.behavior.freq == 8


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("lattice +method.options.alpha=-1", "method.options.alpha is -1"),
        ("lattice method.options.freq=0", "method.options.freq is 0"),
        ("dynsyn method.options.ceiling=3", "method.options.ceiling is 3"),
        ("dynsyn method.options.start_share=1.0", "method.options.start_share is 1.0"),
        ("dynsyn method.options.group_share=2", "method.options.group_share is 2"),
        ("eme method.options.tau=-1", "method.options.tau is -1"),
        ("eme method.options.lr=0", "method.options.lr is 0"),
        ("eme method.options.weight=-1", "method.options.weight is -1"),
        ("dep method.options.dep_frames=-1", "method.options.dep_frames is -1"),
        ("dep method.options.dep_frames=x", "method.options.dep_frames is 'x'"),
        ("dep learn.learning_starts=x", "learn.learning_starts is 'x'"),
        ("dep method.options.probability=2", "method.options.probability is 2"),
        ("dep method.options.kappa=0", "method.options.kappa is 0"),
        ("sar method.options.blend=2", "method.options.blend is 2"),
        ("sar method.options.percentile=200", "method.options.percentile is 200"),
        ("sar method.options.num_synergies=0", "method.options.num_synergies is 0"),
    ],
)
def test_invalid_method_option_is_refused_before_the_run(setting, message, tmp_path):
    method, override = setting.split()
    with pytest.raises(ValueError) as caught:
        Experiment(tiny(f"method={method}", ELBOW, f"run_dir='{tmp_path}/run'", override))
    assert str(caught.value).startswith(message)
    assert not (tmp_path / "run").exists()


def controller(stage) -> DEPExploration:
    return next(m for m in stage.learner.behavior.modules() if isinstance(m, DEPExploration))


@pytest.mark.parametrize(("starts", "expected"), [((), 640), (("learn.learning_starts=100",), 100)])
def test_dep_learning_starts_after_dep_frames_unless_set(starts, expected, tmp_path):
    settings = ("method.options.dep_frames=640", *starts)
    workers = ("collector=process", "collector.num_workers=2", "action_repeat=2")
    run = rival("dep", tmp_path / "run", *workers, *settings, "collector.frames_per_batch=32")
    experiment = Experiment(run)
    stage = experiment.method.stage()
    assert stage.learning_starts == experiment.config.learn.learning_starts == expected
    assert controller(stage).dep_actions == 640 // 2 // 2  # actions of each worker


@pytest.mark.slow
def test_dep_action_count_survives_a_restart_of_collection(tmp_path):
    stage = Experiment(rival("dep", tmp_path / "run", "action_repeat=2")).method.stage()
    stage.restart_collection()
    actions = stage.collect().numel()
    assert stage.frames == 2 * actions and controller(stage).seen == actions
    stage.restart_collection()
    assert controller(stage).seen == actions
    stage.close()


def test_dynsyn_saves_its_groups_and_learns_on_them(tmp_path):
    experiment = Experiment(rival("dynsyn", tmp_path / "run"))
    groups = experiment.run()["groups"]
    file = tmp_path / "run" / "muscle_groups.json"
    assert groups == json.loads(file.read_text())
    file.write_text("[0, 1")
    with pytest.raises(OSError, match=r"muscle_groups\.json is not JSON .*; move it away to group"):
        experiment.method.stage()
    file.unlink()
    assert run_alone(experiment.method.prepare(StopOnSignal())) == {"groups": groups}
    stage = experiment.learned()
    observation = torch.randn(50, experiment.context.spec.observation_dim)
    action = stage.learner.actor(TensorDict({"observation": observation}, [50]))["action"]
    for group in set(groups):
        members = action[:, [i for i, g in enumerate(groups) if g == group]]
        assert (members == members[:, :1]).all()
    assert stage.learner.objective.sac.target_entropy == -len(set(groups))


def test_shuffled_groups_keep_the_group_sizes_of_dynsyn(tmp_path):
    kind = "method.kind=studies.shuffled_groups:ShuffledGroups"
    found, dealt = (
        Experiment(rival("dynsyn", tmp_path / name, *more)).method
        for name, more in (("found", ()), ("dealt", (kind,)))
    )
    groups = [method.found_groups(StopOnSignal()) for method in (found, dealt)]
    assert sorted(groups[0]) == sorted(groups[1]) and groups[0] != groups[1]


def test_dynsyn_amplitude_schedule_scales_with_the_budget(tmp_path):
    stage = Experiment(rival("dynsyn", tmp_path / "run")).method.stage()
    network = stage.learner.actor[0].module
    assert stage.budget == 408  # 608 less the recording; the schedule starts at a third, 136
    for frames, amplitude in ((0, 0.0), (136, 0.0), (272, 0.05), (408, 0.1)):
        stage.progress.frames = frames
        network.advance(frames)
        assert network.amplitude.item() == pytest.approx(amplitude, abs=1e-4)
    stage.close()


@pytest.mark.slow
def test_dynsyn_evaluates_with_the_amplitude_of_the_last_batch(tmp_path):
    experiment = Experiment(rival("dynsyn", tmp_path / "run"))
    experiment.run()
    stage = experiment.learned()
    network = next(m for m in stage.learner.policy.modules() if isinstance(m, DynSynNetwork))
    assert 0.08 < network.amplitude <= 0.1  # as at the first frame of the last batch


def test_dynsyn_paper_preset_has_the_published_amplitude(tmp_path):
    made = tiny("method=dynsyn_paper", ELBOW, f"run_dir='{tmp_path}/run'", "learn.frames=3000000")
    network = Experiment(made).method.stage().learner.actor[0].module
    network.advance(2_000_000)
    assert network.amplitude.item() == pytest.approx(0.05)


def test_leg_and_hand_options_are_chosen_by_the_body(tmp_path, monkeypatch):
    method = Experiment(tiny("method=sac", "env=humanoid-stand")).method
    build, built = Context.make_env, []

    def recorded(context):
        built.append(build(context))
        return built[-1]

    monkeypatch.setattr(Context, "make_env", recorded)
    assert method.resolve_for_body({"legs": 1.0, "hands": 0.66}) == 1.0
    assert method.resolve_for_body({"legs": 2, "hands": 1}) == 2
    assert method.resolve_for_body(0.5) == 0.5
    assert [env.is_closed for env in built] == [True]
    assert Experiment(rival("sar", tmp_path / "run")).method.blend == 0.66
    one_number = rival("dynsyn", tmp_path / "run", "method.options.amplitude=5")
    assert Experiment(one_number).method.amplitude == 5


def test_stage_and_bundle_are_refused_without_synergies(tmp_path):
    for override in ("stage=learn", "synergies.bundle=somewhere"):
        with pytest.raises(ValueError, match="method=sac has one stage and no synergies"):
            Experiment(tiny("method=sac", override, f"run_dir='{tmp_path}/run'"))
