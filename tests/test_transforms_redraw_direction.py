"""RedrawDirection: sampled transitions relabelled with new directions."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv

from tests.point_env import PointEnv
from torchrl_etl.transforms import DirectionPrimer, IntrinsicReward, RedrawDirection

K = 3


def transitions(*size, key="direction"):
    torch.manual_seed(0)
    followed = torch.zeros(*size, K)
    followed[..., 0] = 1.0
    ends = [TensorDict({"observation": torch.randn(*size, K)}, size) for _ in range(2)]
    for end in ends:
        end[key] = followed
    return ends[0].set("next", ends[1])


def count_distinct(directions):
    """The number of distinct directions, which must be unit vectors."""
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(directions.shape[:-1]))
    return len({tuple(row) for row in directions.reshape(-1, K).tolist()})


@pytest.mark.parametrize("size", [(), (40,), (4, 10)])
def test_both_ends_get_the_same_new_unit_vector(size):
    batch = RedrawDirection(DirectionPrimer(K))(transitions(*size))
    assert count_distinct(batch["direction"]) == max(1, torch.Size(size).numel())
    assert torch.equal(batch["direction"], batch["next", "direction"])
    assert not torch.equal(batch["direction"], transitions(*size)["direction"])


def test_share_is_the_fraction_of_redrawn_transitions():
    batch = transitions(2000)
    kept = RedrawDirection(DirectionPrimer(K), share=0.0)(batch.clone())
    assert (kept == batch).all()
    some = RedrawDirection(DirectionPrimer(K), share=0.25)(batch.clone())
    redrawn = (some["direction"] != batch["direction"]).any(-1).float().mean()
    assert redrawn.item() == pytest.approx(0.25, abs=0.04)


def test_new_directions_are_drawn_by_the_primer():
    primer = DirectionPrimer(K, kind="orthonormal", num_directions=2)
    drawn = RedrawDirection(primer)(transitions(200))["direction"]
    assert {tuple(row) for row in drawn.tolist()} == {(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)}


def test_keys_may_be_nested():
    key = ("agent", "direction")
    redraw = RedrawDirection(DirectionPrimer(K, out_key=key))
    batch = redraw(transitions(20, key=key))
    assert count_distinct(batch[key]) == 20
    assert torch.equal(batch[key], batch["next", "agent", "direction"])


def test_buffer_keeps_followed_directions_and_bonus_uses_new_ones():
    encoder = TensorDictModule(nn.Linear(K, K), in_keys=["observation"], out_keys=["embedding"])
    bonus = IntrinsicReward(encoder, normalize=False)
    both = Compose(RedrawDirection(DirectionPrimer(K)), bonus)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50), batch_size=30, transform=both)
    stored = transitions(50)
    buffer.extend(stored)
    for _ in range(2):
        batch = buffer.sample()
        assert count_distinct(batch["direction"]) == 30
        moved = encoder.module(batch["next", "observation"]) - encoder.module(batch["observation"])
        expected = (moved * batch["direction"]).sum(-1, keepdim=True)
        torch.testing.assert_close(batch["next", "intrinsic_reward"], expected)
    assert torch.equal(buffer.storage[:]["direction"], stored["direction"])


def test_works_in_nn_sequential_and_can_be_cloned():
    redraw = RedrawDirection(DirectionPrimer(K), share=0.5)
    model = nn.Sequential(redraw, redraw.clone())
    assert count_distinct(model(transitions(30))["direction"]) > 10
    assert redraw.clone().share == 0.5
    redraw.load_state_dict(RedrawDirection(DirectionPrimer(K)).state_dict())


def test_same_torch_seed_gives_the_same_directions():
    redraw = RedrawDirection(DirectionPrimer(K))
    first, second = (redraw(transitions(9))["direction"] for _ in range(2))
    assert torch.equal(first, second)  # transitions() seeds


def test_misuse_is_refused():
    with pytest.raises(ValueError, match=r"share is 1.5.*\[0, 1\]"):
        RedrawDirection(DirectionPrimer(K), share=1.5)
    redraw = RedrawDirection(DirectionPrimer(K))
    with pytest.raises(KeyError, match=r"reads \('next', 'direction'\), which the data lacks"):
        redraw(transitions(4).exclude(("next", "direction")))
    env = TransformedEnv(PointEnv(), Compose(DirectionPrimer(K), redraw.clone()))
    with pytest.raises(RuntimeError, match="append it to a replay buffer"):
        env.rollout(2)
