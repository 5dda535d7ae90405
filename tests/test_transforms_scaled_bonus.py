"""IntrinsicReward: the running scales of the bonus and of the task reward."""

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from tests.intrinsic_rewards import K, doubler, fixed_encoder, transitions
from tests.point_env import PointEnv
from torchrl_etl.transforms import DirectionPrimer, IntrinsicReward


@pytest.mark.parametrize(("weight", "expected"), [(0.0, 6.0), (1.0, 16.0), (0.5, 11.0)])
def test_extrinsic_weight_adds_the_task_reward(weight, expected):
    data = transitions([1.0], [4.0], [1.0], rewards=[10.0])
    IntrinsicReward(doubler(), normalize=False, extrinsic_weight=weight)(data)
    assert data["next", "intrinsic_reward"].item() == expected
    assert data["next", "reward"].item() == 10.0


def test_bonus_and_task_reward_are_scaled_separately():
    data = transitions([0.0, 0.0], [1.0, -1.0], [1.0, 1.0], rewards=[10.0, 16.0])
    IntrinsicReward(doubler(), extrinsic_weight=0.5)(data)
    # Bonuses 2 and -2 have a standard deviation of 2, rewards 10 and 16 of 3.
    expected = torch.tensor([1 + 0.5 * 10 / 3, -1 + 0.5 * 16 / 3])
    torch.testing.assert_close(data["next", "intrinsic_reward"].flatten(), expected)


def test_scaling_keeps_the_sign_and_gives_unit_deviation():
    ends = 3 + 5 * torch.randn(4_000, generator=torch.Generator().manual_seed(0))
    data = transitions([0.0] * 4_000, ends.tolist(), [1.0] * 4_000)
    bonus = IntrinsicReward(doubler())(data)["next", "intrinsic_reward"].flatten()
    assert abs(bonus.std(correction=0) - 1) < 1e-5
    # The mean is not subtracted, so small positive bonuses stay positive.
    torch.testing.assert_close(bonus.mean(), ends.mean() / ends.std(correction=0))
    assert torch.equal(bonus.sign(), ends.sign())


def test_statistics_are_a_bias_corrected_moving_average():
    transform = IntrinsicReward(doubler(), decay=0.5)
    batches = [[1.0, 3.0], [0.0, 8.0], [-2.0, 2.0]]
    for ends in batches:
        transform(transitions([0.0, 0.0], ends, [1.0, 1.0]))
    # Weights 1/8, 1/4, 1/2 of the three batches, over their sum; bonuses are twice the ends.
    weights = torch.tensor([1.0, 2.0, 4.0]) / 7
    values = 2 * torch.tensor(batches)
    mean = (weights * values.mean(1)).sum()
    variance = (weights * values.square().mean(1)).sum() - mean.square()
    torch.testing.assert_close(transform.deviation.mean, mean)
    torch.testing.assert_close(transform.deviation.variance, variance)
    torch.testing.assert_close(transform.deviation.divisor, variance.sqrt())


def test_scale_follows_an_encoder_that_grows():
    encoder = doubler()
    transform = IntrinsicReward(encoder, decay=0.9)
    data = transitions([0.0] * 4, [1.0, -1.0, 2.0, -2.0], [1.0] * 4)
    early = transform(data.clone())["next", "intrinsic_reward"]
    encoder.module.weight.data *= 100
    for _ in range(100):
        late = transform(data.clone())["next", "intrinsic_reward"]
    torch.testing.assert_close(late, early, rtol=1e-3, atol=0)


@pytest.mark.parametrize("update", [True, False])
def test_zero_bonus_on_a_fresh_transform_is_zero(update):
    transform = IntrinsicReward(doubler(), update_statistics=update)
    for _ in range(3):
        data = transform(transitions([1.0, 2.0], [1.0, 2.0], [1.0, 1.0]))
        assert data["next", "intrinsic_reward"].tolist() == [[0.0], [0.0]]


def test_constant_bonus_is_not_blown_up():
    transform = IntrinsicReward(doubler())
    for _ in range(5):
        data = transform(transitions([0.0], [0.3], [1.0]))
        assert data["next", "intrinsic_reward"].item() == pytest.approx(10.0, rel=1e-4)


def test_bonus_is_unscaled_before_any_update():
    transform = IntrinsicReward(doubler(), update_statistics=False)
    data = transform(transitions([0.0, 0.0], [1.0, -3.0], [1.0, 1.0]))
    assert data["next", "intrinsic_reward"].flatten().tolist() == [2.0, -6.0]


def test_statistics_update_in_eval_mode_until_disabled():
    env = TransformedEnv(
        PointEnv(), Compose(DirectionPrimer(K), IntrinsicReward(fixed_encoder(), decay=0.9))
    )
    transform = env.transform[1]
    assert not transform.training, "TorchRL puts env transforms in eval mode"
    env.rollout(3)
    assert transform.deviation.weight.item() == pytest.approx(1 - 0.9**3)
    transform.update_statistics = False
    env.rollout(3)
    assert transform.deviation.weight.item() == pytest.approx(1 - 0.9**3)


@pytest.mark.parametrize("decay", [0.0, 1.0, -0.1, 1.5])
def test_decay_outside_the_open_interval_is_refused(decay):
    with pytest.raises(ValueError, match=f"decay is {decay}"):
        IntrinsicReward(doubler(), decay=decay)
