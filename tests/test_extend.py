"""docs/extend.md: its files run as printed, and a user's class that cannot run is refused."""

from __future__ import annotations

import re
import shlex
import sys
from typing import ClassVar

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import LossModule
from torchrl.record.loggers import Logger

from tests.commands import command
from tests.configs import CONF, ROOT, composed, tiny
from tests.stages import changed, fill, goes_on_after_a_load, prepared, sample, snapshot, update
from torchrl_etl.command_line import check_overrides, translate
from torchrl_etl.experiment import Experiment
from torchrl_etl.exploration import Exploration
from torchrl_etl.export import command_of
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import SynergyModel, fit_synergies, load_bundle
from torchrl_etl.training import resumed_config

PAGE = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^```\w+\n# (\S+)\n(.*?)^```$", PAGE, re.S | re.M))
MODULES = ("curiosity", "at_random", "recordings", "thrift")
BRIEF = ("explore.frames=192", "learn.frames=64", "evaluation.episodes=1")
OWN = ("exploration=curiosity", "synergies=random")


class Rebuilt(LossModule):
    """Squared error of actions [B, n] reconstructed from d coefficients."""

    def __init__(self, n, d):
        super().__init__()
        self.basis = nn.Parameter(torch.randn(d, n) / n)

    def rebuild(self, actions):
        return actions @ self.basis.mT @ self.basis

    def forward(self, batch):
        error = (self.rebuild(batch["action"]) - batch["action"]).square().mean()
        return TensorDict({"loss_rebuilt": error})


class Learned(SynergyModel):
    """A synergy model with a loss and only the methods that the page's table requires."""

    kind = "learned"

    def __init__(self, low, high, num_synergies):
        self.num_synergies, self.bounds = num_synergies, {"low": low, "high": high}
        self.loss = Rebuilt(len(low), num_synergies)

    def fit(self, actions, *, on_update=lambda: None):
        self.loss.basis.data = torch.linalg.svd(actions).Vh[: self.num_synergies]

    def decoder(self, actions, *, residual=0.0):
        bounds = {key: bound.tolist() for key, bound in self.bounds.items()}
        directions = self.loss.basis.detach()
        return SynergyDecoder.from_directions(
            actions.mean(0), directions, **bounds, residual=residual
        )

    def reconstruct(self, actions):
        return self.loss.rebuild(actions)


class Embedding(Exploration):
    """Embeds a transition as its next and its current observation."""

    def embed(self, rows):
        return rows["next", "observation"], rows["observation"]


class Remembering(Logger):
    logged: ClassVar[dict] = {}

    def __init__(self, exp_name, log_dir, prefix):
        super().__init__(exp_name, log_dir)
        self.prefix = prefix

    def _create_experiment(self):
        return self.logged

    def log_scalar(self, name, value, step=None):
        self.experiment[f"{self.prefix}{name}", step] = value


@pytest.fixture
def page_files(tmp_path, monkeypatch):
    """The files of the page in a new current folder."""
    folder = tmp_path / "my folder"
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    for module in MODULES:
        sys.modules.pop(module, None)


def test_the_page_has_one_short_python_file_and_one_yaml_file_for_each():
    python = {name: code for name, code in FILES.items() if name.endswith(".py")}
    assert set(python) == {f"{module}.py" for module in MODULES}
    assert set(FILES) - set(python) == {
        "conf/exploration/curiosity.yaml",
        "conf/synergies/random.yaml",
        "conf/method/thrift.yaml",
    }
    for name, code in python.items():
        assert sum(bool(line.strip()) for line in code.splitlines()) < 40, name


def test_both_stages_run_with_the_classes_of_the_page(page_files, tmp_path):
    settings = ("learn.prefill=true", "learn.decoder.residual=0.5", *BRIEF)
    summary = Experiment(tiny(f"run_dir='{tmp_path}/run'", *OWN, *settings)).run()
    assert summary["learn"]["frames"] == 64
    assert load_bundle(tmp_path / "run")[1].kind == "random"


def config_with_model(kind, tmp_path):
    """A run with a synergy model of this file, in place of pca, whose section has no options."""
    own = ("synergies=pca", f"synergies.kind=tests.test_extend:{kind}", *BRIEF)
    return tiny(f"run_dir='{tmp_path}/run'", *own, "pictures=true", "vaf_curve.dims=[1]")


def test_synergy_model_with_a_loss_runs_both_stages_and_draws_pictures(tmp_path):
    summary = Experiment(config_with_model("Learned", tmp_path)).run()
    assert summary["learn"]["frames"] == 64
    assert load_bundle(tmp_path / "run")[1].kind == "learned"
    drawn = {file.name for file in (tmp_path / "run" / "pictures").iterdir()}
    assert drawn >= {"synergies.png", "vaf.png", "embedding.png"}


@pytest.mark.parametrize("fails", [False, True])
def test_alignment_of_a_users_embed_or_its_error_is_reported(fails, tmp_path, monkeypatch):
    def embed(self, rows):
        raise KeyError("phase")

    if fails:
        monkeypatch.setattr(Embedding, "embed", embed)
    config, said = tiny(f"run_dir='{tmp_path}/run'", "stage=explore", *BRIEF), []
    config.exploration = {"kind": "tests.test_extend:Embedding"}
    found = Experiment(config, say=said.append).run()["synergies"]
    assert ("direction_alignment" in found) is not fails
    assert any("could not embed its transitions (KeyError('phase'))" in s for s in said) is fails


def test_users_logger_gets_the_scalars_and_another_class_is_refused(tmp_path):
    name = "tests.test_extend:Remembering"
    asked = ("method=sac", "learn.frames=64", "evaluation.episodes=1", f"log=['{name}']")
    config = tiny(f"run_dir='{tmp_path}/run'", *asked)
    config.logger_kwargs = {"Remembering": {"prefix": "my/"}}
    summary = Experiment(config).run()
    returns = summary["learn"]["return"]
    assert Remembering.logged["my/learn/eval/return", 64] == pytest.approx(returns["after"])
    config.log = ["tests.test_extend:Learned"]
    with pytest.raises(ValueError, match=r"^log is .*no class Learned that is derived from Logger"):
        Experiment(config)


def test_stage_1_with_the_classes_of_the_page_resumes_with_equal_numbers(page_files, tmp_path):
    def make():
        return Explorer(Experiment(tiny("run_dir=unused", *OWN)).context).stage

    assert goes_on_after_a_load(make, tmp_path)


def test_curiosity_rewards_the_prediction_error_and_trains_its_model(page_files):
    found = Explorer(Experiment(tiny("run_dir=unused", *OWN)).context)
    found.stage.restart_collection()
    for _ in range(6):
        found.stage.collect()
    batch, loss = prepared(found.stage), found.exploration.loss
    inputs = torch.cat([batch["observation"], batch["action"]], -1)
    error = (loss.model(inputs) - batch["next", "observation"]).square().sum(-1, keepdim=True)
    torch.testing.assert_close(batch["next", "surprise"], error)
    before = snapshot(loss), snapshot(found.stage.learner.behavior)
    update(found.stage)
    assert changed(loss, before[0]) and changed(found.stage.learner.behavior, before[1])
    found.stage.close()


def test_random_synergies_fit_recordings_worse_than_nmf(page_files, capsys):
    code = compile(FILES["recordings.py"], "recordings.py", "exec")
    sys.path.append("")
    exec(code, {"__name__": "__main__"})
    nmf, at_random = (float(line.split()[-1]) for line in capsys.readouterr().out.splitlines())
    assert nmf > 0.99 > at_random > 0


def test_synergies_recipe_sets_the_updates_of_a_users_model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Learned, "updates", 2000)
    monkeypatch.setattr(Learned, "fit", lambda self, actions: seen.append(self.updates))
    seen = []
    np.save("emg.npy", np.random.default_rng(0).random((40, 4)))
    own = ("kind=pca", "synergies.kind=tests.test_extend:Learned", "num=2", "updates=7")
    assert command("synergies.py", "data=emg.npy", *own, "out=found") == 0
    assert set(seen) == {7}


def test_synergies_recipe_accepts_the_random_kind(page_files, capsys):
    np.save("emg.npy", np.random.default_rng(0).random((40, 4)))
    assert command("synergies.py", "data=emg.npy", "kind=random", "num=2", "out=found") == 0
    assert "2 synergies account for" in capsys.readouterr().out


def test_thrift_method_runs_and_resumes_with_equal_numbers(page_files, tmp_path):
    def make():
        return Experiment(tiny("run_dir=unused", "method=thrift")).method.stage()

    assert goes_on_after_a_load(make, tmp_path)
    settings = ("method=thrift", "learn.frames=96", "evaluation.episodes=1")
    summary = Experiment(tiny(f"run_dir='{tmp_path}/run'", *settings)).run()
    assert summary["learn"]["frames_charged"] == 96
    assert resumed_config(tmp_path / "run").method.kind == "thrift:Thrift"


def test_thrift_method_learns_on_reward_minus_effort(page_files):
    asked = ("method=thrift", "method.options.price=2")
    stage = Experiment(tiny("run_dir=unused", *asked)).method.stage()
    stage.restart_collection()
    fill(stage)
    batch = sample(stage)
    stage.close()
    effort = ((batch["action"] + 1) / 2).square().mean(-1, keepdim=True)
    cost = batch["next", "reward"] - batch["next", "thrifty_reward"]
    torch.testing.assert_close(cost, 2 * effort)
    assert "thrifty_reward" in stage.learner.update(batch)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("options.price", -1, r"method\.options\.price is -1"),
        ("options.cost", 1, r"method\.options\.cost is not an option of .*\(price\)"),
        ("kind", "thrift:Theft", r"method\.kind is .*thrift has no class Theft that is"),
        ("kind", "thrift:EffortCost", "no class EffortCost that is derived from Method"),
        ("kind", "thrift", r"method\.kind is 'thrift'; choose one of etl, sac, lattice"),
        ("kind", None, r"method\.kind is None; choose one of etl, sac, lattice"),
    ],
)
def test_unusable_method_settings_are_refused(key, value, words, page_files):
    config = tiny("run_dir=unused", "method=thrift")
    OmegaConf.update(config, f"method.{key}", value, force_add=True)
    with pytest.raises(ValueError, match=words):
        Experiment(config)


def test_command_line_accepts_kinds_with_a_config_file(page_files):
    settings = ("exploration.lr=0.1", "synergies.seed=3", "method=thrift", "method.options.price=1")
    check_overrides(CONF / "config.yaml", [*OWN, *settings], "")
    assert translate(["synergies=random"], CONF) == ["synergies=random"]
    assert translate(["exploration.kind=a:B"], CONF) == ["exploration.kind=a:B"]
    kinds = ["method.kind=a:B", "method.kind=sar"]
    assert translate(kinds, CONF) == ["method.kind=a:B", "method=sar"]


def test_recipe_finds_a_users_config_files(page_files, capsys):
    assert command("etl_sac.py", *OWN, "method=thrift", "synergies.seed=3", "--cfg=job") == 0
    config = OmegaConf.create(capsys.readouterr().out)
    kinds = [config[group].kind for group in ("exploration", "synergies", "method")]
    assert kinds == ["curiosity:Curiosity", "at_random:RandomSynergies", "thrift:Thrift"]
    assert command("etl_sac.py", "exploration=curiosity", "--help") == 0
    assert "exploration:   # exploration=curiosity\n  kind: curiosity" in capsys.readouterr().out


def test_exported_command_names_a_users_config_files(page_files):
    made = tiny("run_dir=unused", *OWN, "exploration.lr=0.1")
    told = shlex.split(command_of(made, composed, CONF, "toy"))[2:]
    assert {*OWN, "exploration.lr=0.1"} < {*told}
    check_overrides(CONF / "config.yaml", told, "")


@pytest.mark.parametrize(
    ("kind", "error", "words"),
    [
        ("curiosity:Curiositas", ValueError, "curiosity has no class Curiositas that is"),
        ("curiosity:Surprise", ValueError, "no class Surprise that is derived from Exploration"),
        ("no_such:Curiosity", ImportError, "There is no module 'no_such' for 'no_such:Curiosity'"),
        ("curiosity", ValueError, r"exploration\.kind is 'curiosity'; choose one of metric, metra"),
    ],
)
def test_unknown_exploration_kind_is_refused(kind, error, words, page_files):
    config = tiny("run_dir=unused", *OWN)
    config.exploration.kind = kind
    with pytest.raises(error, match=words):
        Explorer(Experiment(config).context)


def test_users_kind_without_a_config_file_is_refused(page_files):
    config = tiny("run_dir=unused", "exploration.kind=curiosity:Curiosity")
    with pytest.raises(ValueError, match=r"add a file for this kind to \./conf/exploration\.$"):
        Explorer(Experiment(config).context)


def test_fit_synergies_takes_a_users_class_by_name(page_files):
    model = fit_synergies(torch.rand(50, 6), "at_random:RandomSynergies", 2, seed=3)
    assert (model.kind, model.seed) == ("random", 3)
