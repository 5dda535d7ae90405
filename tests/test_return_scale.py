"""ReturnScale: discounted returns by hand, for any division into batches."""

from __future__ import annotations

import pytest
import torch

from torchrl_etl.modules import ReturnScale

REWARD = torch.tensor([[1.0, 2.0, 3.0, 4.0], [0.0, -8.0, 0.0, 2.0]])
DONE = torch.tensor([[False, True, False, False], [False, False, False, True]])
# γ = 1/2; an episode ends after the second reward of the first simulator.
SUMS = torch.tensor([[1.0, 2.5, 3.0, 5.5], [0.0, -8.0, -4.0, 0.0]])


def seen(bound: float, *cuts: int) -> ReturnScale:
    scale = ReturnScale(0.5, bound=bound)
    parts = zip(REWARD.tensor_split(cuts, 1), DONE.tensor_split(cuts, 1), strict=True)
    for reward, done in parts:
        scale.update(reward, done)
    return scale


@pytest.mark.parametrize("cuts", [(), (1,), (1, 3)])
def test_scale_is_the_larger_of_std_and_maximum_over_bound(cuts):
    deviation = SUMS.double().std(correction=0)
    torch.testing.assert_close(seen(100.0, *cuts).scale, deviation)
    torch.testing.assert_close(seen(2.0, *cuts).scale, torch.tensor(4.0, dtype=torch.float64))
    torch.testing.assert_close(seen(2.0)(REWARD), REWARD / 4)


def test_running_return_follows_the_episode_across_batches():
    scale = ReturnScale(0.5, bound=1e-3)  # low, so that the largest return sets the scale
    going = torch.zeros(1, 2, dtype=torch.bool)
    scale.update(torch.tensor([[4.0, 4.0]]), going, torch.tensor([[7, 7]]))  # 4 and 6
    assert scale.largest == 6.0
    scale.update(torch.tensor([[-6.0, 0.0]]), going, torch.tensor([[8, 8]]))  # not -6 + 3
    scale.update(torch.tensor([[4.0, 0.0]]), going, torch.tensor([[7, 7]]))  # 4 + 6 / 2
    assert scale.largest == 7.0
    assert scale.mean == (4 + 6 - 6 - 3 + 7 + 3.5) / 6


def test_running_return_of_a_new_episode_starts_at_zero():
    scale = ReturnScale(0.5)
    ends = torch.tensor([[False, True]])
    scale.update(torch.tensor([[2.0, 2.0]]), ends, torch.tensor([[7, 7]]))
    scale.update(torch.tensor([[2.0, 2.0]]), ends, torch.tensor([[9, 9]]))
    assert scale.mean == (2 + 3 + 2 + 3) / 4


def test_forget_drops_running_returns_and_keeps_the_scale():
    scale = seen(2.0)
    scale.reset_episodes()
    scale.update(torch.tensor([[20.0], [0.0]]), torch.zeros(2, 1, dtype=torch.bool))
    assert scale.scale == 10.0  # 20 / 2 and not (20 + 5.5 / 2) / 2


def test_rewards_are_unscaled_until_a_return_is_nonzero():
    scale = ReturnScale(0.9)
    assert torch.equal(scale(REWARD), REWARD)
    scale.update(torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.bool))
    assert torch.equal(scale(REWARD), REWARD)


def test_state_round_trip():
    other = ReturnScale(0.5, bound=2.0)
    other.load_state_dict(seen(2.0).state_dict())
    assert other.scale == seen(2.0).scale


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [({"gamma": 1.0}, "gamma is 1"), ({"gamma": 0.9, "bound": 0}, "bound is 0")],
)
def test_unusable_settings_are_refused(kwargs, words):
    with pytest.raises(ValueError, match=words):
        ReturnScale(**kwargs)
