"""What stage 1 takes from any exploration."""

from __future__ import annotations

import torch

from tests.stages import explorer
from torchrl_etl.modules import HeldNoise


def test_noise_of_the_actor_that_is_configured_for_stage_1_collects():
    assert isinstance(explorer("explore.noise.kind=held").stage.learner.behavior, HeldNoise)


def test_synergies_see_actions_for_the_directions_that_the_exploration_relabels():
    """Of the policy as it is now, for other directions than those that were followed."""
    found = explorer()
    found.stage.collect()
    rows = found.stage.newest(32)
    (redraw,) = found.exploration.relabel_transforms()
    torch.manual_seed(0)
    relabelled = redraw(rows.clone())
    torch.manual_seed(0)
    seen = found.actions()
    torch.testing.assert_close(seen, found.shown(relabelled)["action"])
    assert not torch.allclose(seen, found.shown(rows)["action"])
    found.stage.close()
