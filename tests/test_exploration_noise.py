"""Stage 1 with exploration=noise: only the synergy model learns, and a killed run resumes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from tests.configs import tiny
from tests.stages import changed, explorer, fill, goes_on_after_a_load, snapshot
from torchrl_etl.experiment import Experiment
from torchrl_etl.exploration import LastingNoise
from torchrl_etl.modules.lasting_noise import HeldNormal
from torchrl_etl.synergies import load_bundle
from torchrl_etl.training import run_alone

NOISE = "exploration=noise"


def test_actions_are_the_tanh_of_the_noise_in_the_bounds():
    """For noise x, a std of 2 and bounds [0, 4] the action is 2 + 2 tanh(2 x)."""
    low, high = torch.zeros(3), torch.full((3,), 4.0)
    policy = LastingNoise(low, high, HeldNormal(4), std=2.0)
    begins = torch.ones(5, 1, dtype=torch.bool)
    torch.manual_seed(0)
    action = policy(TensorDict({"is_init": begins}, [5]))["action"]
    torch.manual_seed(0)
    noise = HeldNormal(4)(torch.zeros(5, 3), begins.squeeze(-1))
    torch.testing.assert_close(action, 2 + 2 * (2 * noise).tanh())


@pytest.mark.parametrize("color", ["pink", "held"])
def test_update_changes_only_the_gmvae(color):
    found = explorer(NOISE, f"exploration.color={color}")
    stage, learner = found.stage, found.stage.learner
    fill(stage)
    assert isinstance(learner.behavior, LastingNoise)
    assert isinstance(learner.behavior.draw, HeldNormal) is (color == "held")
    others = learner.actor, learner.objective.sac
    before, model = [snapshot(part) for part in others], snapshot(found.model.model)
    scalars = run_alone(stage.learn())
    assert "loss_gmvae" in scalars.keys() and "loss_actor" not in scalars.keys()
    assert changed(found.model.model, model)
    assert not any(changed(part, was) for part, was in zip(others, before, strict=True))
    stage.close()


def test_synergies_that_are_fitted_once_get_no_updates():
    found = explorer(NOISE, "synergies=pca")
    fill(found.stage)
    assert run_alone(found.stage.learn()) is None and found.stage.progress.updates == 0
    assert run_alone(found.condense()).num_synergies == 2
    found.stage.close()


def test_both_stages_run_on_noise_without_direction_alignment(tmp_path):
    brief = ("explore.frames=192", "learn.frames=64", "evaluation.episodes=1", "synergies=nmf")
    summary = Experiment(tiny(f"run_dir='{tmp_path}/run'", NOISE, *brief)).run()
    assert summary["learn"]["frames_charged"] == 192 + 64
    assert load_bundle(tmp_path / "run")[1].kind == "nmf"
    assert "direction_alignment" not in summary["synergies"]


@pytest.mark.parametrize("color", ["pink", "held"])
def test_resumed_stage_equals_an_uninterrupted_one(color, tmp_path):
    settings = (NOISE, f"exploration.color={color}")
    assert goes_on_after_a_load(lambda: explorer(*settings).stage, tmp_path)


@pytest.mark.slow
def test_noise_is_drawn_in_worker_processes_too():
    found = explorer(NOISE, "collector=process", "collector.num_workers=2")
    batch = found.stage.collect()
    assert batch["action"].std() > 0.3
    found.stage.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("explore.fit.actions=policy", "explore.fit.actions is 'policy', but exploration=noi"),
        ("explore.fit.actions=mean", "use sampled or activation"),
        ("exploration.color=brown", "exploration.color is 'brown'; choose one of pink, held"),
        ("exploration.std=0", "exploration.std is 0"),
        ("exploration.longest=0", "exploration.longest is 0"),
        ("exploration.color=held exploration.exponent=0", "exploration.exponent is 0"),
    ],
)
def test_settings_unusable_with_noise_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        explorer(NOISE, *settings.split())
