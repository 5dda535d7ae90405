"""What stage 1 takes from any Exploration: noise, relabeling and transforms."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import StepCounter

from tests.configs import tiny
from tests.stages import explorer
from torchrl_etl.experiment import Experiment
from torchrl_etl.exploration import Exploration
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import HeldNoise


class Counted(Exploration):
    """A user's Exploration whose transform has no array methods for VectorCollector."""

    keep = ("step_count",)

    def __init__(self, spec, **options):
        super().__init__(spec)

    def reset_transforms(self):
        return (StepCounter(),)


def test_configured_actor_noise_is_the_behavior_policy_of_stage_1():
    assert isinstance(explorer("explore.noise.kind=held").stage.learner.behavior, HeldNoise)


def test_synergies_are_fitted_to_actions_for_relabeled_directions():
    """Actions of the current policy, for redrawn directions instead of those that were followed."""
    found = explorer()
    found.stage.collect()
    rows = found.stage.newest(32)
    (redraw,) = found.exploration.relabel_transforms()
    torch.manual_seed(0)
    relabelled = redraw(rows.clone())
    torch.manual_seed(0)
    seen = found.actions()
    torch.testing.assert_close(seen, found.selector(relabelled)["action"])
    assert not torch.allclose(seen, found.selector(rows)["action"])
    found.stage.close()


def test_unsupported_transform_falls_back_to_torchrls_collector():
    config = tiny("run_dir=unused")
    config.exploration.kind = f"{__name__}:Counted"
    with pytest.warns(UserWarning, match="since StepCounter has no array_step and array_reset"):
        found = Explorer(Experiment(config).context)
    found.stage.restart_collection()
    batch = found.stage.collect().reshape(4, 8)  # of 4 simulators
    assert (batch["step_count"].squeeze(-1) == torch.arange(8)).all()
    found.stage.close()
