"""The configuration of a resumed run: damaged, older, or with overrides."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.configs import tiny
from torchrl_etl.training import resumed_config, validate
from torchrl_etl.training.config import REMOVED


@pytest.fixture
def file(tmp_path) -> Path:
    """The config.yaml in the folder of a run."""
    path = tmp_path / "config.yaml"
    path.write_text(OmegaConf.to_yaml(tiny(f"run_dir='{tmp_path}'", "frames=1000")))
    return path


def changed(file: Path, **values) -> None:
    config = OmegaConf.load(file)
    for key, value in values.items():
        OmegaConf.update(config, key.replace("__", "."), value, force_add=True)
    file.write_text(OmegaConf.to_yaml(config))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"- a\n- list\n",
        b"just words",
        b"learn: [not closed",
        b"learn: ${not closed",
        b"\x00\xff\xfe",
        b"env: overactuated\nseed: 0\nexplore: 3\nlearn: {}\ncheckpoint: {}\n",
        b"env: overactuated\nseed: 0\nexplore: {}\nlearn: null\ncheckpoint: {}\n",
    ],
)
def test_damaged_config_gives_a_one_line_error(content, file):
    file.write_bytes(content)
    with pytest.raises(ValueError, match="is damaged") as caught:
        resumed_config(file.parent)
    assert "\n" not in str(caught.value)
    assert "copy it from a backup of the run, or start a new run" in str(caught.value)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_truncated_config_is_refused(share, file):
    text = file.read_text()
    file.write_text(text[: int(share * len(text))])
    with pytest.raises(ValueError, match="is damaged"):
        resumed_config(file.parent)


def test_config_with_former_setting_names_is_refused(file):
    changed(file, learn__anchor=0.1)
    words = "other names (learn.anchor, now learn.decoder.distillation_weight)"
    with pytest.raises(ValueError, match=re.escape(words)):
        resumed_config(file.parent, defaults=tiny())


@pytest.mark.parametrize("key", REMOVED)
def test_config_with_a_removed_setting_resumes_only_at_its_default(key, file):
    name = key.replace(".", "__")
    changed(file, **{name: REMOVED[key]})
    assert resumed_config(file.parent, defaults=tiny()) == tiny(
        f"run_dir='{file.parent}'", "frames=1000"
    )
    changed(file, **{name: 0.25})
    with pytest.raises(ValueError, match=rf"has {re.escape(key)}=0\.25, which was removed"):
        resumed_config(file.parent, defaults=tiny())


def test_config_with_the_former_method_key_resumes(file):
    changed(file, method__learner="sac")
    config = OmegaConf.load(file)
    del config.method["kind"]
    file.write_text(OmegaConf.to_yaml(config))
    resumed = resumed_config(file.parent, defaults=tiny())
    assert resumed.method == {"name": "etl", "kind": "sac"}
    validate(resumed)


def test_settings_newer_than_the_run_take_their_defaults_with_a_warning(file):
    config = OmegaConf.load(file)
    del config.learn["prefill"], config["vaf_curve"]
    file.write_text(OmegaConf.to_yaml(config))
    with pytest.warns(UserWarning, match=r"without learn\.prefill=.*vaf_curve=|vaf_curve=.*"):
        resumed = resumed_config(file.parent, defaults=tiny())
    assert resumed.learn.prefill == tiny().learn.prefill
    assert resumed.vaf_curve == tiny().vaf_curve
    validate(resumed)


def test_newer_setting_given_on_resume_does_not_warn(file, recwarn):
    config = OmegaConf.load(file)
    del config.learn["prefill"]
    file.write_text(OmegaConf.to_yaml(config))
    asked = not tiny().learn.prefill
    resumed = resumed_config(file.parent, [f"learn.prefill={asked}"], defaults=tiny())
    assert resumed.learn.prefill is asked
    assert not [warning for warning in recwarn if "is of a release without" in str(warning.message)]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["+log_every=5"], "+log_every is a setting that already exists; leave out the plus."),
        (["~learn.frames"], "~learn.frames would remove a setting"),
        (["~learn.frames=608"], "~learn.frames would remove a setting"),
        (["learn.frame=5"], "no setting 'learn.frame'; did you mean learn.frames?"),
        (["+learn.sac.gama=0.9"], "no setting 'learn.sac.gama'; did you mean learn.sac.gamma?"),
        (["++learn.sac.gama=0.9"], "no setting 'learn.sac.gama'; did you mean learn.sac.gamma?"),
        (["zzz.yyy=1"], "no setting 'zzz.yyy'; see its config.yaml."),
        (["seed.of=1"], "no setting 'seed.of'"),
        (["seed=1"], "seed cannot be changed when a run is resumed"),
        (["+env_kwargs.g=1"], "env_kwargs.g cannot be changed when a run is resumed"),
        (["learner=plain"], "learner cannot be changed when a run is resumed"),
        (["experiment=quick"], "experiment cannot be changed when a run is resumed"),
        (["actor.hidden=[16]"], "actor.hidden cannot be changed when a run is resumed"),
        (["num_synergies=3"], "num_synergies cannot be changed when a run is resumed"),
        (["env=myoHandPose"], "env cannot be changed when a run is resumed"),
        (["learn.sac.num_critics=1"], "learn.sac.num_critics cannot be changed when a run is"),
        (["action_repeat=2"], "action_repeat cannot be changed when a run is resumed"),
        (["learn.frames=[1"], "learn.frames=[1"),
        (["frames=2000", "learn.frames=900"], "both set the budget; pass only one of them."),
    ],
)
def test_invalid_override_on_resume_gives_a_one_line_error(overrides, words, file):
    before = file.read_text()
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        resumed_config(file.parent, overrides)
    assert "\n" not in str(caught.value)
    assert file.read_text() == before


def test_allowed_overrides_on_resume_are_applied(file):
    asked = ["log_every=7", "++checkpoint.every=9", "+logger_kwargs.wandb.project=mine"]
    resumed = resumed_config(file.parent, [*asked, f"resume={file.parent}"])
    assert (resumed.log_every, resumed.checkpoint.every) == (7, 9)
    assert resumed.logger_kwargs.wandb.project == "mine"
    assert resumed.frames == 1000


def test_learn_frames_on_resume_replaces_frames(file):
    resumed = resumed_config(file.parent, ["learn.frames=900"])
    assert resumed.frames is None and resumed.learn.frames == 900


def test_a_budget_of_exploring_is_refused_once_that_is_over(file):
    assert resumed_config(file.parent, ["explore.frames=64"]).explore.frames == 64
    (file.parent / "synergies").mkdir()
    with pytest.raises(ValueError, match=r"already has its synergies; leave explore\.frames out"):
        resumed_config(file.parent, ["explore.frames=64"])
