"""EME: its bonus against the check list of transforms and values worked out by hand."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.objectives import SoftUpdate

from tests.lookup_tables import table, transitions
from tests.point_env import ACTION_DIM, OBSERVATION_DIM, PointEnv
from tests.test_baselines_eme import D12, LOC, PREDICTIONS, ROWS, SCALE, fixed, policy, predictors
from tests.transform_checks import TransformChecks
from torchrl_etl.baselines import EMEBonus, EMELoss, RewardEnsemble
from torchrl_etl.modules import StateEncoder


def fixed_networks() -> tuple[StateEncoder, RewardEnsemble]:
    encoder = fixed(StateEncoder, OBSERVATION_DIM, 2, hidden=(8,))
    ensemble = fixed(RewardEnsemble, OBSERVATION_DIM, ACTION_DIM, 3, hidden=(8,))
    with torch.no_grad():
        for parameter in ensemble.parameters():
            parameter.mul_(6)  # so that their variance exceeds the lower bound of the scale
    return encoder, ensemble


class TestEMEBonus(TransformChecks):
    @staticmethod
    def transform(nested: bool = False) -> EMEBonus:
        def key(name: str) -> Any:
            return ("agent", name) if nested else name

        return EMEBonus(
            *fixed_networks(),
            weight=0.5,
            in_keys=(key("observation"), key("action")),
            out_keys=(key("intrinsic_reward"), key("total_reward")),
            reward_key=key("reward"),
        )

    def check_values(self, rollout: TensorDict) -> None:
        encoder, ensemble = fixed_networks()
        following = rollout["next"]
        with torch.no_grad():
            step = encoder(following.select("observation"))["embedding"]
            step -= encoder(rollout.select("observation"))["embedding"]
            inputs = rollout.select("observation", "action")
            variance = ensemble(inputs)["reward_prediction"].var(-1, correction=0, keepdim=True)
        assert variance.max() > 1
        expected = step.norm(dim=-1, keepdim=True) * variance.clamp(1, 10)
        torch.testing.assert_close(following["intrinsic_reward"], expected, rtol=1e-4, atol=1e-5)
        total = following["reward"] + 0.5 * following["intrinsic_reward"]
        torch.testing.assert_close(following["total_reward"], total)
        assert expected.max() > 1e-3
        names = {"embedding", "reward_prediction", "intrinsic_reward", "total_reward"}
        assert set(rollout.keys()).isdisjoint(names)

    def test_no_env(self) -> None:
        data = bonus_of_tables()(steps([0, 1], [1, 2], [7.0, 8.0]))
        assert data["next", "intrinsic_reward"].flatten().tolist() == pytest.approx([5.0, D12 * 4])
        assert data["next", "reward"].flatten().tolist() == [7.0, 8.0]

    def test_compose(self) -> None:
        data = Compose(bonus_of_tables())(steps([0], [1], [0.0]))
        assert data["next", "intrinsic_reward"].item() == pytest.approx(5.0)

    def test_model(self) -> None:
        reads = [("next", "total_reward")]
        network = TensorDictModule(nn.Linear(1, 2), in_keys=reads, out_keys=["out"])
        transform = bonus_of_tables()
        for model in (
            nn.Sequential(transform, network),
            TensorDictSequential(transform, network),
        ):
            assert model(steps([0], [1], [0.0]))["out"].shape == (1, 2)

    @pytest.mark.parametrize("appended", [False, True])
    def test_replay_buffer(self, appended: bool) -> None:
        transform = bonus_of_tables()
        # 64 draws of two rows contain both.
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(8), batch_size=64, transform=None if appended else transform
        )
        if appended:
            buffer.append_transform(transform)
        buffer.extend(steps([0, 0], [1, 2], [0.0, 0.0]))
        key = ("next", "intrinsic_reward")
        assert key not in buffer._storage[:].keys(True, True), "nothing is written on extend"
        assert {round(x, 4) for x in buffer.sample()[key].flatten().tolist()} == {5.0, 6.0}
        transform.encoder.module.rows.data *= 10
        transform.ensemble.module.rows.data[0] = torch.tensor([0.0, 4.0])
        assert {round(x, 3) for x in buffer.sample()[key].flatten().tolist()} == {200.0, 240.0}
        assert key not in buffer._storage[:].keys(True, True)

    def test_inverse(self) -> None:
        data = steps([0], [1], [0.0])
        assert (self.transform().inv(data) == data).all()


def bonus_of_tables(**options: Any) -> EMEBonus:
    """Distances 5, 6 and sqrt(13); variances 1/4, 4 and 25 at states 0, 1 and 2."""
    return EMEBonus(table(*ROWS), predictors([[0.0, 1.0], [0.0, 4.0], [0.0, 10.0]]), **options)


def steps(states: list[int], following: list[int], rewards: list[float]) -> TensorDict:
    return transitions(states, following, rewards, [False] * len(states), 3)


def test_scale_multiplies_the_distance_and_has_a_maximum() -> None:
    for maximum, scale in ((10.0, 10.0), (2.0, 2.0), (100.0, 25.0)):
        data = bonus_of_tables(max_scale=maximum)(steps([2], [0], [0.0]))
        assert data["next", "intrinsic_reward"].item() == pytest.approx(6.0 * scale)


@pytest.mark.parametrize(("weight", "total"), [(0.0, 10.0), (1.0, 15.0), (0.5, 12.5)])
def test_total_reward_is_the_tasks_plus_the_weighted_bonus(weight: float, total: float) -> None:
    data = bonus_of_tables(weight=weight)(steps([0], [1], [10.0]))
    assert data["next", "total_reward"].item() == pytest.approx(total)
    assert data["next", "reward"].item() == 10.0


def test_normalized_bonus_has_weight_times_the_rewards_deviation() -> None:
    # Bonuses 5 and 4 sqrt(13), rewards 10 and 16 with a deviation of 3.
    transform = bonus_of_tables(weight=0.5, normalize=True)
    data = transform(steps([0, 1], [1, 2], [10.0, 16.0]))
    bonus = torch.tensor([[5.0], [4 * D12]])
    deviation = (4 * D12 - 5.0) / 2
    torch.testing.assert_close(data["next", "intrinsic_reward"], bonus)
    added = data["next", "total_reward"] - data["next", "reward"]
    torch.testing.assert_close(added, 0.5 * 3.0 * bonus / deviation)
    torch.testing.assert_close(added.std(correction=0), torch.tensor(0.5 * 3.0))


def test_normalized_bonus_is_independent_of_the_metrics_scale() -> None:
    added = []
    for scale in (1.0, 1000.0):
        transform = bonus_of_tables(normalize=True)
        transform.encoder.module.rows.data *= scale
        data = transform(steps([0, 1], [1, 2], [10.0, 16.0]))
        added.append(data["next", "total_reward"])
    torch.testing.assert_close(*added)


def test_normalized_bonus_without_any_reward_has_unit_deviation() -> None:
    data = bonus_of_tables(normalize=True)(steps([0, 1], [1, 2], [0.0, 0.0]))
    assert data["next", "total_reward"].std(correction=0).item() == pytest.approx(1.0)


def test_state_dict_includes_statistics_of_a_normalized_bonus() -> None:
    one, other = bonus_of_tables(normalize=True), bonus_of_tables(normalize=True)
    one(steps([0, 1], [1, 2], [10.0, 16.0]))
    other.load_state_dict(one.state_dict())
    later = steps([1, 2], [2, 0], [3.0, 4.0])
    results = [transform(later.clone())["next", "total_reward"] for transform in (one, other)]
    assert torch.equal(*results)


def test_time_dimensions() -> None:
    data = steps([0, 1], [1, 2], [0.0, 0.0]).reshape(1, 2)
    bonus = bonus_of_tables()(data)["next", "intrinsic_reward"]
    torch.testing.assert_close(bonus, torch.tensor([[[5.0], [4 * D12]]]))


def test_bonus_is_zero_for_an_unchanged_state() -> None:
    assert bonus_of_tables()(steps([1], [1], [0.0]))["next", "intrinsic_reward"].item() < 1e-4


def test_bonus_uses_the_networks_that_the_loss_trains() -> None:
    encoder, ensemble = table(*ROWS), predictors(PREDICTIONS)
    loss = EMELoss(encoder, ensemble, policy(LOC, SCALE))
    SoftUpdate(loss, tau=0.1)
    bonus = EMEBonus(encoder, ensemble)
    data = transitions([0, 1], [1, 2], [0.0, 0.0], [False, False], 3)
    before = bonus(data.clone())["next", "intrinsic_reward"]
    optimizer = torch.optim.SGD(loss.parameters(), 0.1)
    sum(value for key, value in loss(data).items() if key.startswith("loss_")).backward()
    optimizer.step()
    assert (bonus(data)["next", "intrinsic_reward"] != before).all()


def test_networks_are_held_by_reference_and_left_alone() -> None:
    encoder, ensemble = (network.train() for network in fixed_networks())
    transform = EMEBonus(encoder, ensemble)
    rollout = TransformedEnv(PointEnv(), transform).rollout(2)
    for held in (transform, transform.clone()):
        assert held.encoder is encoder and held.ensemble is ensemble
    transform.to("meta")
    for network in (encoder, ensemble):
        assert network.training
        assert all(p.requires_grad and p.device.type == "cpu" for p in network.parameters())
    assert not list(transform.parameters()) and not transform.state_dict()
    assert not rollout["next", "intrinsic_reward"].requires_grad
    twin = copy.deepcopy(transform.clone())
    assert twin.encoder is not encoder


def test_reward_spec_declares_bonus_and_total() -> None:
    env = TransformedEnv(SerialEnv(2, PointEnv), TestEMEBonus.transform())
    assert env.reward_keys == ["intrinsic_reward", "reward", "total_reward"]
    assert env.full_reward_spec["total_reward"].shape == (2, 1)


def test_wrong_networks_and_options_are_refused() -> None:
    encoder, ensemble = fixed_networks()
    with pytest.raises(TypeError, match="The encoder is a Linear without in_keys"):
        EMEBonus(nn.Linear(1, 1), ensemble)
    with pytest.raises(ValueError, match=r"The ensemble reads \['observation'\]"):
        EMEBonus(encoder, encoder)
    for options, message in (
        ({"max_scale": 0.5}, "max_scale is 0.5"),
        ({"weight": -1.0}, "weight is -1.0"),
        ({"normalize": "no"}, "normalize is 'no'; it must be true or false"),
        ({"in_keys": "observation"}, "pass a pair of keys, the observation and the action"),
        ({"out_keys": ("bonus",)}, "pass a pair of keys, the bonus and the total reward"),
    ):
        with pytest.raises(ValueError, match=message):
            EMEBonus(encoder, ensemble, **options)


def test_missing_entries_are_named() -> None:
    data = steps([0], [1], [0.0])
    for key in ("observation", "action", ("next", "reward")):
        with pytest.raises(KeyError, match="EMEBonus reads"):
            bonus_of_tables()(data.exclude(key))
    with pytest.raises(KeyError, match="'next'"):
        bonus_of_tables()(data.exclude("next"))
    with pytest.raises(KeyError, match="name the right one in in_keys"):
        TransformedEnv(
            PointEnv(), EMEBonus(*fixed_networks(), in_keys=("state", "action"))
        ).rollout(1)
