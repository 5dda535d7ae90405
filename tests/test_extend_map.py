"""A synergy map of one's own: both stages, bundles and the zoo."""

from __future__ import annotations

import sys

import pytest
import torch
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type

from tests.configs import CONF, composed, tiny
from torchrl_etl import zoo
from torchrl_etl.experiment import Experiment
from torchrl_etl.export import export_run
from torchrl_etl.modules import SARDecoder, SynergyMap
from torchrl_etl.synergies import BundleError, PCASynergies, load_bundle
from torchrl_etl.training import resumed_config


class Clamped(SynergyMap):
    """a = z·basis + ρ·r, clamped to the bounds."""

    def __init__(self, num_synergies, action_dim, *, low, high, residual=0.0):
        mix = Mix(num_synergies, low, high, residual)
        super().__init__(mix, in_keys=["synergy"], out_keys=["action"])
        self.num_synergies, self.action_dim, self.residual = num_synergies, action_dim, residual

    @property
    def config(self):
        return super().config | {"residual": self.residual}

    @torch.no_grad()
    def encode(self, action):
        return (action @ self.module.basis.pinverse()).clamp(-1, 1)


class Mix(nn.Module):
    def __init__(self, d, low, high, residual):
        super().__init__()
        self.basis, self.residual = nn.Parameter(torch.zeros(d, len(low))), residual
        self.register_buffer("low", torch.tensor(low))
        self.register_buffer("high", torch.tensor(high))

    def forward(self, synergy):
        d = len(self.basis)
        action = synergy[..., :d] @ self.basis
        if self.residual:
            action = action + self.residual * synergy[..., d:]
        return action.clamp(self.low, self.high)


class WithMap(PCASynergies):
    def decoder(self, actions, *, residual=0.0):
        bounds = {"low": self.low.tolist(), "high": self.high.tolist()}
        made = Clamped(self.num_synergies, len(self.low), **bounds, residual=residual)
        made.module.basis.data.copy_(self.basis)
        return made


class FixedResidual(PCASynergies):
    def decoder(self, actions, *, residual=0.0):
        return SARDecoder.from_basis(actions.mean(0), self.basis, low=self.low, high=self.high)


class WeightNotInConfig(WithMap):
    def decoder(self, actions, *, residual=0.0):
        made = super().decoder(actions, residual=residual)
        made.register_buffer("usual", actions.mean(0))
        return made


class NoMap(PCASynergies):
    def decoder(self, actions, *, residual=0.0):
        return nn.Linear(self.num_synergies, len(self.low))


def config_with_model(kind, run, *overrides):
    brief = ("explore.frames=192", "learn.frames=64", "evaluation.episodes=1", "vaf_curve.dims=[1]")
    own = ("synergies=pca", f"synergies.kind={__name__}:{kind}")
    return tiny(f"run_dir='{run}'", *own, *brief, *overrides)


def test_model_with_its_own_map_runs_both_stages_and_goes_to_the_zoo(tmp_path):
    run = tmp_path / "run"
    Experiment(config_with_model("WithMap", run, "learn.prefill=true", "pictures=true")).run()
    assert (run / "pictures" / "synergies.png").is_file()
    assert load_bundle(run)[1].config["kind"] == f"{__name__}:Clamped"
    learner = Experiment(resumed_config(run), resume=run).learned().learner
    export_run(run, tmp_path / "toy", composed, CONF, episodes=1)
    policy, env = zoo.load(tmp_path / "toy")
    rows = env.reset()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        own = learner.policy(rows.clone())["action"]
    assert torch.equal(policy(rows.clone())["action"], own)
    env.close()


def test_run_imports_the_module_of_its_own_map_and_a_bundle_does_not(tmp_path, monkeypatch):
    run = tmp_path / "run"
    Experiment(config_with_model("WithMap", run)).run()
    monkeypatch.delitem(sys.modules, __name__)  # as in a new process
    Experiment(resumed_config(run), resume=run).learned()
    monkeypatch.delitem(sys.modules, __name__)
    with pytest.raises(BundleError, match=f"files may not import '{__name__}'; if you trust"):
        load_bundle(run)


def test_run_learns_in_given_synergies_of_its_own_map_if_the_model_is_named(tmp_path, monkeypatch):
    first, second = tmp_path / "first", tmp_path / "second"
    Experiment(config_with_model("WithMap", first)).run()
    given = f"synergies.bundle='{first}'"
    monkeypatch.delitem(sys.modules, __name__)  # as in a new process
    with pytest.raises(BundleError, match="import it first in Python, or, to learn with it, give"):
        Experiment(tiny(f"run_dir='{second}'", given))
    Experiment(config_with_model("WithMap", second, given)).run()
    monkeypatch.delitem(sys.modules, __name__)
    Experiment(resumed_config(second), resume=second).learned()


def test_zoo_entry_with_a_map_of_a_module_that_is_not_imported_is_refused(tmp_path, monkeypatch):
    Experiment(config_with_model("WithMap", tmp_path / "run")).run()
    export_run(tmp_path / "run", tmp_path / "toy", composed, CONF, episodes=1)
    monkeypatch.delitem(sys.modules, __name__)
    for opened in (zoo.load, zoo.untrained):
        with pytest.raises(zoo.ZooError, match=f"may not import '{__name__}'; if you trust it, im"):
            opened(tmp_path / "toy")
    assert __name__ not in sys.modules


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("FixedResidual", "is a SARDecoder, whose residual is fixed at 0.34"),
        ("WeightNotInConfig", r"do not make a decoder: (.|\n)*Unexpected key.*usual"),
        ("NoMap", "is a Linear; it must be a SynergyMap"),
    ],
)
def test_model_with_an_unsupported_decoder_is_refused_before_stage_1(kind, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        Experiment(config_with_model(kind, tmp_path / "run", "learn.decoder.residual=1.0"))
    assert not (tmp_path / "run").exists()
