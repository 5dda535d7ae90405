"""Uniform warm-up: the number of random actions, their range, and resuming."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type

from tests.stages import learn_stage
from torchrl_etl.modules import UniformWarmup
from torchrl_etl.training.stage import frames_per_action

RANDOM = set_exploration_type(ExplorationType.RANDOM)


def test_uniform_actions_spread_evenly_over_the_bounds():
    warmup = UniformWarmup(Bounded(torch.tensor([-1.0, 2.0]), torch.tensor([1.0, 6.0])), 20_000)
    with RANDOM:
        drawn = warmup(TensorDict({"action": torch.zeros(20_000, 2)}, [20_000]))["action"]
    torch.testing.assert_close(drawn.mean(0), torch.tensor([0.0, 4.0]), atol=0.05, rtol=0)
    expected = torch.tensor([2.0, 4.0]) / 12**0.5
    torch.testing.assert_close(drawn.std(0), expected, atol=0.05, rtol=0)


def test_deterministic_actions_are_unchanged_and_not_counted():
    warmup = UniformWarmup(Bounded(-1, 1, shape=(2,)), 4)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        data = warmup(TensorDict({"action": torch.full((4, 2), 7.0)}, [4]))
    assert (data["action"] == 7.0).all()
    assert warmup.seen == 0


def test_a_negative_number_of_actions_is_refused():
    with pytest.raises(ValueError, match="actions is -1"):
        UniformWarmup(Bounded(-1, 1, shape=(2,)), -1)


def test_stage_starts_with_uniform_synergies_then_uses_its_policy():
    stage = learn_stage(None, "learn.init_random_frames=64")
    with torch.no_grad():  # a policy at the upper bound
        for parameter in stage.learner.actor.parameters():
            parameter.zero_()
        head = [m for m in stage.learner.actor.modules() if isinstance(m, torch.nn.Linear)][-1]
        head.bias[: stage.learner.decoder.synergy_dim] = 50.0
    batches = [stage.collect()["synergy"] for _ in range(3)]
    assert all(batch.abs().median() < 0.9 for batch in batches[:2])
    assert (batches[2] > 0.9).all()
    stage.close()


def test_a_resumed_stage_does_not_warm_up_again():
    stage = learn_stage(None, "learn.init_random_frames=64")
    stage.progress.frames = 64
    stage.restart_collection()
    warmup = next(m for m in stage.learner.behavior.modules() if isinstance(m, UniformWarmup))
    assert warmup.seen == warmup.actions == 64
    stage.close()


def test_frames_per_action_counts_async_workers_and_action_repeat():
    assert frames_per_action({"kind": "async", "num_workers": 3}, action_repeat=2) == 6
    assert frames_per_action({"kind": "single", "num_workers": 3}, action_repeat=2) == 2
