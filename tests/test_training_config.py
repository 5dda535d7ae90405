"""Configurations compose; a setting that cannot be used is refused with its remedy."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tests.configs import CONF, tiny
from torchrl_etl.command_line import translate
from torchrl_etl.envs import list_tasks
from torchrl_etl.envs.simulator import simulator
from torchrl_etl.experiment import Experiment
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import save_bundle
from torchrl_etl.training import resumed_config, run_folder, validate
from torchrl_etl.training.config import REMOVED, RENAMED, quoted, resume_setting, split_seeds
from torchrl_etl.training.resumed import parse_override
from torchrl_etl.training.run_folder import RunFolder

GROUPS = {
    name: sorted(p.stem for p in (CONF / name).glob("*.yaml"))
    for name in ("experiment", "faithful")
}


@pytest.mark.parametrize(("experiment", "faithful"), itertools.product(*GROUPS.values()))
def test_every_pair_of_presets_is_valid(experiment, faithful):
    validate(tiny(f"experiment={experiment}", f"faithful={faithful}"))


@pytest.mark.parametrize("task", [task.name for task in list_tasks()])
def test_every_task_of_the_paper_is_valid(task):
    validate(tiny(f"env={task}"))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("env=myoHandPenTwist", "myoHandPenTwirl"),
        ("env=CartPole-v1", "continuous"),
        ("env=myoLegWalk goal=random", "myoHandPose"),
        ("stage=lern", "stage is 'lern'; choose one of explore, learn, all (nearest: learn)"),
        ("goal=fix", "fixed"),
        ("num_synergies=0", "num_synergies is 0; it must be a whole number, 1 or more"),
        ("action_repeat=0", "action_repeat is 0; it must be a whole number, 1 or more"),
        ("num_synergies=17", "overactuated has 16 actuators; choose at most that many"),
        ("explore.frames=-5", "explore.frames is -5; it must be a whole number, 1 or more"),
        ("learn.frames=many", "learn.frames is 'many'; it must be a whole number, 1 or more"),
        ("learn.replay_ratio=0", "learn.replay_ratio is 0"),
        ("explore.replay_ratio=x compile=null", "explore.replay_ratio is 'x'; it must be a number"),
        ("seed=-1", "seed is -1; it must be a whole number, 0 or more"),
        ("seed=0.5", "seed is 0.5"),
        ("collector.frames_per_batch=33", "it must be a multiple of their number"),
        ("checkpoint.keep=1", "checkpoint.keep is 1; it must be a whole number, 2 or more"),
        ("exploration.relabel=2", "exploration.relabel is 2; it must be a number in [0, 1]"),
        ("explore.fit.actions=loc", "policy, mean, sampled, activation"),
        ("learn.decoder.fine_tuning=freeze", "nearest: frozen"),
        ("learn.decoder.residual=2", "learn.decoder.residual is 2; it must be a number in [0, 1]"),
        ("learn.decoder.residual_std=0", "learn.decoder.residual_std is 0; it must be a number"),
        ("learn.decoder.residual_std=1 learn.decoder.residual=0", "learn.decoder.residual is 0"),
        ("explore.fit.final_updates=0.5", "explore.fit.final_updates is 0.5"),
        ("evaluation.episodes=1.5", "evaluation.episodes is 1.5"),
        ("learn.decoder.lr=-1", "learn.decoder.lr is -1; it must be a number above 0"),
        ("exploration.lr=0", "exploration.lr is 0; it must be a number above 0"),
        ("exploration.tau=null", "exploration.tau is None; it must be a number in (0, 1]"),
        ("exploration=metra exploration.lr=x", "exploration.lr is 'x'; it must be a number"),
        ("frames=9000 explore.frames=x", "explore.frames is 'x'; it must be a whole number"),
        ("learn.frames=x compile=null", "learn.frames is 'x'; it must be a whole number"),
        ("learn.replay_ratio=1e9", "learn.replay_ratio is 1000000000.0; it must be a number in (0"),
        ("learn.decoder.distillation_weight=nan", "learn.decoder.distillation_weight is nan"),
        ("learn.batch_size=1", "learn.batch_size is 1; it must be a whole number, 2 or more"),
        ("explore.reward_scale=abc", "explore.reward_scale is 'abc'"),
        ("explore.sac.action_std=0", "explore.sac.action_std is 0; it must be a number above 0"),
        ("exploration.direction.kind=foo", "exploration.direction.kind is 'foo'; choose one of"),
        ("exploration.encoder.embedding_dim=0", "exploration.encoder.embedding_dim is 0"),
        ("exploration.encoder.hidden=[0]", "exploration.encoder.hidden is [0]; it must be a list"),
        ("+synergies.updates=-3", "synergies.updates is -3; it must be a whole number, 1 or more"),
        ("exploration.bonus.decay=1", "exploration.bonus.decay is 1"),
        ("exploration.bonus.extrinsic_weight=a", "exploration.bonus.extrinsic_weight is 'a'"),
        ("exploration.metric.margin=-1", "exploration.metric.margin is -1"),
        ("exploration=metra exploration.metra.lambda_init=-1", "exploration.metra.lambda_init is"),
        ("exploration.direction.num_directions=3 exploration.direction.kind=orthonormal", "3"),
        ("explore.fit.actions=activation", "activation"),
        ("learn.critic.bins=51", "categorical critics need a bound on returns"),
        ("learn.critic.bins=2.5", "bins is 2.5; it must be a whole number"),
        ("learn.critic.bins=51 learn.sac.return_bound=0", "learn.sac.return_bound is 0; it must"),
        ("logger_kwargs=3", "logger_kwargs is 3; it must map names to values"),
        ("learn.noise.kind=hold", "choose one of independent, held"),
        ("learn.sac.num_critics=0", "learn.sac.num_critics is 0; it must be a whole number"),
        ("learn.noise.kind=held learn.noise.exponent=0", "learn.noise.exponent is 0; it must be"),
        ("learn.noise.kind=held learn.noise.longest=x", "learn.noise.longest is 'x'; it must be"),
        ("learn.sac.lr_end=2", "learn.sac.lr_end is 2; it must be a number in [0, 1]"),
        ("learn.sac.return_bound=0", "learn.sac.return_bound is 0; it must be a number above 0"),
        ("synergies.kl_weight=-1", "synergies.kl_weight is -1; it must be a number 0 or more"),
        ("learn.n_steps=0", "learn.n_steps is 0; it must be a whole number, 1 or more"),
        ("learn.sac.ema_decay=1", "learn.sac.ema_decay is 1; it must be a number in [0, 1)"),
        ("critic.body=resnet", "choose one of mlp, residual"),
        ("frames=10", "frames is 10, but the stages before learning take 600"),
        ("actor.hidden=[0]", "actor.hidden is [0]; it must be a list of whole numbers"),
        ("vaf_curve.dims=3", "vaf_curve.dims is 3"),
        ("threads=-1", "threads is -1"),
        ("pictures=abc", "pictures is 'abc'; it must be true or false"),
        ("compile=yes_please", "compile is 'yes_please'; it must be true, false or null"),
        ("device=null", "device is None; it must be a string"),
        ("device=meta", "device is 'meta'; use cpu"),
        ("env=3", "env is 3; it must be a string"),
        ("env=Pendulum-v1 +env_kwargs.gravity=0", "does not take env_kwargs={'gravity': 0}"),
        ("log=tensorboard", "log is 'tensorboard'; it must be a list"),
        ("log=[wandb]", "pip install wandb"),
        ("stage=learn", "stage=learn needs synergies=PATH"),
        ("stage=explore synergies=some/x", "leave it out or use stage=learn"),
        ("synergies=nowhere", "nowhere"),
        ("device=gpu", "device is 'gpu'; use cpu, cuda or cuda:0"),
        ("log=[csv,tensorbord]", "nearest: tensorboard"),
        ("exploration.metric.regularizer=hing", "hinge"),
    ],
)
def test_invalid_setting_is_refused_with_its_remedy(override, words, tmp_path):
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        Experiment(tiny(f"run_dir='{tmp_path}/run'", *override.split()))
    assert words in str(caught.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_without_a_device_is_refused():
    with pytest.raises(ValueError, match="no CUDA device is available; use device=cpu"):
        Experiment(tiny("device=cuda"))


def test_a_second_run_in_the_same_folder_is_refused(tmp_path):
    experiment = Experiment(tiny(f"run_dir='{tmp_path}/my run'"))
    experiment.folder.open(resume=False)
    as_a_shell_takes_it = f"continue it with 'resume={tmp_path}/my run', or"
    with pytest.raises(FileExistsError, match=re.escape(as_a_shell_takes_it)):
        Experiment(tiny(f"run_dir='{tmp_path}/my run'")).run()


def test_unwritable_run_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OSError, match="cannot be written"):
        Experiment(tiny(f"run_dir='{tmp_path}/file/run'")).run()


def test_resume_of_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no run"):
        resumed_config(tmp_path)


def test_bundle_sets_num_synergies_and_an_absolute_path(tmp_path, monkeypatch):
    decoder = SynergyDecoder(3, 16)
    names = [f"muscle_{i}" for i in range(16)]
    save_bundle(decoder, tmp_path / "bundle", task="overactuated", actuators=names)
    monkeypatch.chdir(tmp_path)
    experiment = Experiment(tiny("synergies=bundle", "num_synergies=2"))
    assert experiment.config.num_synergies == 3
    assert experiment.config.synergies.bundle == str(tmp_path / "bundle")


def test_config_with_given_synergies_has_no_exploration_or_prefill(tmp_path):
    names = [f"muscle_{i}" for i in range(16)]
    save_bundle(SynergyDecoder(3, 16), tmp_path / "a", task="overactuated", actuators=names)
    given = tiny(f"synergies='{tmp_path}/a'", "learn.prefill=true", f"run_dir='{tmp_path}/run'")
    experiment = Experiment(given)
    experiment.folder.open(resume=False)
    saved = resumed_config(tmp_path / "run", defaults=tiny())
    assert (saved.stage, saved.learn.prefill) == ("learn", False)
    assert saved.exploration == {"kind": None}
    assert saved.synergies == {"kind": None, "bundle": str(tmp_path / "a")}
    assert Experiment(saved, resume=tmp_path / "run").config == experiment.config


def test_unique_run_folders_are_numbered(tmp_path):
    folders = [RunFolder(tmp_path / "run", tiny(), unique=True) for _ in range(3)]
    for folder in folders:
        folder.open(resume=False)
    assert [folder.path.name for folder in folders] == ["run", "run-2", "run-3"]
    for folder in folders:
        assert OmegaConf.load(folder.path / "config.yaml").run_dir == str(folder.path)
        folder.close()


def test_wandb_gets_title_and_config_and_the_same_id_on_resume(tmp_path, monkeypatch):
    begun = []

    def get_logger(kind, folder, title, *, wandb_kwargs):
        begun.append((kind, title, wandb_kwargs))
        return None

    monkeypatch.setattr(run_folder, "get_logger", get_logger)
    config = tiny("+logger_kwargs.wandb.project=mine", "learn.frames=777")
    (tmp_path / "a").mkdir()
    for _ in range(2):
        RunFolder(tmp_path / "a", config)._logger("wandb")
    (tmp_path / "b").mkdir()
    RunFolder(tmp_path / "b", config)._logger("wandb")
    titles, kwargs = [title for _, title, _ in begun], [kwargs for _, _, kwargs in begun]
    assert titles == ["a", "a", "b"]
    assert kwargs[0]["project"] == "mine" and kwargs[0]["config"]["learn"]["frames"] == 777
    assert kwargs[0]["id"] == kwargs[1]["id"] != kwargs[2]["id"]


def test_env_kwargs_reach_the_simulator(tmp_path):
    config = tiny("env=Pendulum-v1", "+env_kwargs.g=0.0", f"run_dir='{tmp_path}/run'")
    experiment = Experiment(OmegaConf.merge(config, {"num_synergies": 1}))
    assert simulator(experiment.context.make_env()).g == 0.0


# Bodies in bfloat16 ----------------------------------------------------------------------------


def bfloat16_lines(
    monkeypatch, tmp_path, capabilities: dict[str, bool], *overrides: str
) -> list[str]:
    lines = []
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    config = tiny(f"run_dir='{tmp_path}/run'", "method=sac", *overrides)
    Experiment(config, say=lines.append)
    return [line for line in lines if "bfloat16" in line]


@pytest.mark.parametrize("network", ["actor", "critic"])
def test_bfloat16_warns_without_hardware_support(network, monkeypatch, tmp_path):
    without = {"avx2": True, "avx512_f": True, "avx512_bf16": False}
    asked = f"{network}.body=residual_bfloat16"
    assert bfloat16_lines(monkeypatch, tmp_path, without, asked) == [
        "Warning: this processor has no bfloat16 instructions, so body=residual_bfloat16 is slower "
        "than body=residual, the same in float32."
    ]


@pytest.mark.parametrize("name", ["avx512_bf16", "amx_bf16", "bf16", "sve_bf16"])
def test_bfloat16_does_not_warn_with_hardware_support(name, monkeypatch, tmp_path):
    assert not bfloat16_lines(monkeypatch, tmp_path, {name: True}, "actor.body=residual_bfloat16")


def test_float32_does_not_warn(monkeypatch, tmp_path):
    assert not bfloat16_lines(monkeypatch, tmp_path, {}, "actor.body=residual")


@pytest.mark.parametrize(
    "preset",
    [
        "env=overactuated",
        *(
            f"{group}={path.stem}"
            for group in ("experiment", "faithful", "learner", "method")
            for path in sorted((CONF / group).glob("*.yaml"))
        ),
    ],
)
def test_no_preset_chooses_bfloat16(preset):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[preset, "run_dir=unused"])
    assert "bfloat16" not in OmegaConf.to_yaml(config, resolve=True)


# Former and short ways to write a setting --------------------------------------------------------


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("learn.anchor=0.1", "learn.anchor is called learn.decoder.distillation_weight now."),
        ("+learn.anchor=0.1", "learn.anchor is called learn.decoder.distillation_weight now."),
        ("explore.gmvae.hidden=[8]", "explore.gmvae.hidden is called synergies.hidden now."),
        ("method.learner=sac", "method.learner is called method.kind now."),
        ("learn.sac.n_steps=3", "learn.sac.n_steps is called learn.n_steps now."),
    ],
)
def test_renamed_setting_is_refused_with_its_new_name(argument, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        translate([argument], CONF)


@pytest.mark.parametrize("key", REMOVED)
def test_removed_setting_is_refused(key):
    with pytest.raises(ValueError, match=f"{re.escape(key)} was removed, .* leave it out"):
        translate([f"{key}=0.25"], CONF)


def test_misspelled_kind_of_synergies_is_refused_with_the_nearest():
    with pytest.raises(ValueError, match=r"synergies is 'nmff'; choose .*\(nearest: nmf\)"):
        translate(["synergies=nmff"], CONF)
    assert translate(["synergies=body"], CONF) == ["synergies.bundle=body"]


@pytest.mark.parametrize("now", sorted(set(RENAMED.values())))
def test_every_new_name_of_a_renamed_setting_exists(now):
    key = now.partition("=")[0]
    configs = tiny("learn.prefill=true"), tiny("exploration=metra")  # null by default
    assert any(OmegaConf.select(config, key) is not None for config in configs)


def test_former_presets_paths_and_kinds_compose():
    former = ("learner=residual", "experiment=laptop", "faithful=default", "synergies=some/run")
    null = ("learner=null", "experiment=null", "faithful=null", "synergies=some/run")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=translate([*former, "run_dir=unused"], CONF))
        as_null = compose("config", overrides=translate([*null, "run_dir=unused"], CONF))
        same = compose("config", overrides=["synergies.bundle=some/run", "run_dir=unused"])
        kinds = translate(["synergies.kind=nmf", "exploration.kind=metra"], CONF)
        others = compose("config", overrides=[*kinds, "run_dir=unused"])
    assert config == as_null == same
    assert (others.synergies.kind, others.exploration.kind) == ("nmf", "metra")
    assert "hidden" not in others.synergies, "a kind brings its own settings"


# Several seeds -----------------------------------------------------------------------------------


def test_each_of_several_seeds_has_the_folder_of_a_single_run():
    config = tiny("seeds=[3,5]", "env=overactuated")
    config.run_dir, config.progress = "runs/a-${seed}", True
    configs = split_seeds(config)
    assert [(own.seed, own.run_dir, own.progress) for own in configs] == [
        (3, "runs/a-3", True),
        (5, "runs/a-5", False),
    ]
    assert all(own.seeds is None for own in configs)
    # Another process has no Hydra, whose resolvers the default run_dir uses.
    assert not any(OmegaConf.is_interpolation(own, "run_dir") for own in configs)


def test_seeds_of_one_run_dir_get_subfolders():
    configs = split_seeds(tiny("seeds=[3,5]", "run_dir=runs/a"))
    assert [own.run_dir for own in configs] == ["runs/a/seed3", "runs/a/seed5"]


@pytest.mark.parametrize("seeds", ["[]", "[0,0]", "[0,1.5]", "[true,2]", "3", "text"])
def test_invalid_seeds_are_refused(seeds):
    with pytest.raises(ValueError, match=r"seeds is .*; it must be a list of different whole"):
        split_seeds(tiny(f"seeds={seeds}", "run_dir=runs/a"))


FOLDERS = ("runs/a", "my runs/b", "läufe/c", "it's/d", "a,b/e", "1", "null", "g/\\", "h/\\'")


def test_quoted_folder_names_survive_hydra():
    for folder in FOLDERS:
        assert parse_override(f"run_dir={quoted(folder)}").value() == folder
    found = parse_override(resume_setting([Path(folder) for folder in FOLDERS])).value()
    assert [str(each) for each in found] == list(FOLDERS)
