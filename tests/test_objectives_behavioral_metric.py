"""BehavioralMetricLoss: the checks of a loss, values by hand, options."""

# ruff: noqa: RUF012  (class attributes that configure a check list are constants)

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SoftUpdate

from tests.lookup_tables import table, transitions
from tests.loss_checks import LossChecks
from torchrl_etl.modules import GaussianDynamics, StateEncoder
from torchrl_etl.objectives import BehavioralMetricLoss
from torchrl_etl.objectives.behavioral_metric import _dynamics_nll
from torchrl_etl.objectives.pairs import partners

OBSERVATION_DIM, EMBEDDING_DIM = 5, 3


class MetricChecks(LossChecks):
    default_keys = {"reward": "reward", "terminated": "terminated"}
    targets = {"target_encoder_params"}
    recorded = {("next", "observation"), ("next", "reward")}
    trained = {"loss_metric": {"encoder_params"}, "loss_regularizer": {"encoder_params"}}
    # Far above the differences of rewards, so that pairs are regularized.
    options: dict[str, Any] = {"epsilon": 1.0, "margin": 3.0}

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> BehavioralMetricLoss:
        keys = {"in_keys": [("agent", "observation")]} if nested else {}
        encoder = StateEncoder(OBSERVATION_DIM, EMBEDDING_DIM, hidden=(16, 16), **keys)
        loss = BehavioralMetricLoss(encoder, *self.networks(), **self.options | kwargs)
        if nested:
            loss.set_keys(reward=("agent", "reward"), terminated=("agent", "over"))
        return loss

    def networks(self) -> list[nn.Module]:
        return []

    def make_data(self, batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
        observation, following = torch.randn(2, *batch, OBSERVATION_DIM)
        reward = torch.randn(*batch, 1)
        terminated = torch.rand(*batch, 1) < 0.2
        if nested:
            root = {"agent": {"observation": observation}}
            after = {"observation": following, "reward": reward, "over": terminated}
            after = {"agent": after}
        else:
            root = {"observation": observation}
            after = {"observation": following, "reward": reward, "terminated": terminated}
        return TensorDict(root | {"next": TensorDict(after, batch)}, batch)


class TestSampled(MetricChecks):
    pass


class TestAllPairs(MetricChecks):
    options = MetricChecks.options | {"pairs": "all"}


class TestMico(MetricChecks):
    options = MetricChecks.options | {"distance": "mico", "regularizer": "literal"}


class TestNoRegularizer(MetricChecks):
    options = {"regularizer": "none"}
    trained = {"loss_metric": {"encoder_params"}}


class TestNoTarget(MetricChecks):
    options = MetricChecks.options | {"delay_encoder": False}
    targets = set()


class TestGaussian(MetricChecks):
    options = MetricChecks.options | {"divergence": "gaussian"}
    trained = MetricChecks.trained | {"loss_dynamics": {"dynamics_params"}}

    def networks(self) -> list[nn.Module]:
        return [GaussianDynamics(EMBEDDING_DIM, hidden=(16,))]


# Values on a lookup table of embeddings


ROWS = [0.0, 0.0], [3.0, 4.0], [0.0, 6.0]


@pytest.mark.parametrize("pairs", ["permuted", "all"])
def test_two_states_by_hand(pairs: str) -> None:
    # d(0, 1) = 5; next states 1 and 2: d = sqrt(9 + 4); rewards differ by 1.
    loss = BehavioralMetricLoss(table(*ROWS), gamma=0.5, pairs=pairs, regularizer="none")
    out = loss(transitions([0, 1], [1, 2], [2.0, 1.0], [False, False], 3))
    torch.testing.assert_close(
        out["loss_metric"].item(), 0.5 * (5 - 1 - 0.5 * 13**0.5) ** 2, rtol=1e-5, atol=1e-6
    )
    assert out["mean_distance"].item() == pytest.approx(5.0)
    assert out["mean_reward_difference"].item() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("ended", "divergence"),
    [([True, True], 0.0), ([True, False], 6.0), ([False, True], 5.0), ([False, False], 13**0.5)],
)
def test_ended_episodes_share_one_absorbing_state(ended: list[bool], divergence: float) -> None:
    loss = BehavioralMetricLoss(table(*ROWS), gamma=0.5, regularizer="none")
    out = loss(transitions([0, 1], [1, 2], [0.0, 0.0], ended, 3))
    expected = 0.5 * (5 - 0.5 * divergence) ** 2
    assert out["loss_metric"].item() == pytest.approx(expected, rel=1e-4)


def test_ended_episodes_have_distance_zero_in_micos_metric_too() -> None:
    loss = BehavioralMetricLoss(table(*ROWS), distance="mico", gamma=0.5, regularizer="none")
    out = loss(transitions([0, 1], [1, 2], [0.0, 0.0], [True, True], 3))
    assert out["loss_metric"].item() == pytest.approx(0.5 * out["mean_distance"].item() ** 2)


def test_hinge_and_literal_by_hand() -> None:
    data = transitions([0, 1], [1, 2], [0.0, 0.0], [False, False], 3)
    options = {"epsilon": 0.1, "weight": 0.5}
    hinge = BehavioralMetricLoss(table(*ROWS), margin=7.0, **options)(data)
    literal = BehavioralMetricLoss(table(*ROWS), regularizer="literal", **options)(data)
    assert hinge["loss_regularizer"].item() == pytest.approx(0.5 * (7 - 5) ** 2, rel=1e-4)
    assert literal["loss_regularizer"].item() == pytest.approx(0.5 * 25, rel=1e-4)


def test_all_pairs_is_the_mean_over_every_other_sample() -> None:
    data = transitions([0, 1, 2], [0, 1, 2], [0.0, 1.0, 3.0], [False] * 3, 3)
    loss = BehavioralMetricLoss(
        table(*ROWS), gamma=0.0, pairs="all", regularizer="none", reduction="none"
    )
    d01, d02, d12 = 5.0, 6.0, 13**0.5
    e01, e02, e12 = (0.5 * (d - r) ** 2 for d, r in ((d01, 1), (d02, 3), (d12, 2)))
    expected = torch.tensor([(e01 + e02) / 2, (e01 + e12) / 2, (e02 + e12) / 2])
    torch.testing.assert_close(loss(data)["loss_metric"], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("samples", [2, 3, 17])
@pytest.mark.parametrize("pairs", ["permuted", "all"])
def test_pairs_exclude_self_and_use_every_sample_equally_often(pairs: str, samples: int) -> None:
    for _ in range(20):
        partner = partners(samples, torch.device("cpu"), pairs)
        assert (partner != torch.arange(samples).unsqueeze(1)).all()
        assert partner.flatten().bincount().unique().numel() == 1


def test_permuted_pairs_change_from_call_to_call() -> None:
    draws = {tuple(partners(8, torch.device("cpu")).flatten().tolist()) for _ in range(8)}
    assert len(draws) > 1


def test_reward_scale_multiplies_rewards_and_is_saved() -> None:
    data = transitions([0, 1], [1, 2], [2.0, 1.0], [False, False], 3)
    loss = BehavioralMetricLoss(table(*ROWS), regularizer="none")
    loss.reward_scale = 10.0
    assert loss(data)["mean_reward_difference"].item() == pytest.approx(10.0)
    other = BehavioralMetricLoss(table(*ROWS), regularizer="none")
    other.load_state_dict(loss.state_dict())
    assert other.reward_scale.item() == 10.0


class Doubling(nn.Module):
    def forward(self, embedding: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return 2 * embedding, torch.ones_like(embedding)


def gaussian_loss() -> BehavioralMetricLoss:
    dynamics = TensorDictModule(Doubling(), in_keys=["x"], out_keys=["mean", "std"])
    return BehavioralMetricLoss(
        table(*ROWS), dynamics, divergence="gaussian", gamma=0.5, regularizer="none"
    )


def test_gaussian_divergence_by_hand() -> None:
    out = gaussian_loss()(transitions([0, 1], [1, 2], [2.0, 1.0], [False, False], 3))
    # Means (0, 0) and (6, 8), equal spread: W2 = 10.
    assert out["loss_metric"].item() == pytest.approx(0.5 * (5 - 1 - 0.5 * 10) ** 2, rel=1e-4)
    # Next embeddings (3, 4) and (0, 6) under those means.
    square = (9 + 16 + 36 + 4) / 2
    log_two_pi = torch.log(torch.tensor(2 * torch.pi)).item()
    assert out["loss_dynamics"].item() == pytest.approx(0.5 * square + log_two_pi, rel=1e-5)


def test_gaussian_divergence_uses_the_target_embedding() -> None:
    loss = gaussian_loss()
    for value in loss.target_encoder_params.values(True, True):
        value.mul_(2.0)
    out = loss(transitions([0, 1], [1, 2], [2.0, 1.0], [False, False], 3))
    assert out["loss_metric"].item() == pytest.approx(0.5 * (5 - 1 - 0.5 * 20) ** 2, rel=1e-4)


def test_dynamics_gradients_stay_moderate_for_a_small_scale() -> None:
    loc = torch.tensor([1.0, 1.0], requires_grad=True)
    scale = torch.tensor([0.5, 1e-3], requires_grad=True)
    _dynamics_nll(torch.tensor([2.0, 1.1]), loc, scale).backward()
    # -error / scale where the plain likelihood has -error / scale ** 2.
    torch.testing.assert_close(loc.grad, torch.tensor([-2.0, -100.0]), rtol=1e-3, atol=0.0)
    torch.testing.assert_close(scale.grad, torch.tensor([-3.0, -9999.0]), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("divergence", ["sampled", "gaussian"])
def test_bootstrapped_distances_stay_bounded(divergence: str) -> None:
    gamma, samples = 0.9, 64
    encoder = StateEncoder(OBSERVATION_DIM, EMBEDDING_DIM, hidden=(32, 32))
    dynamics = [GaussianDynamics(EMBEDDING_DIM, hidden=(32,))] if divergence == "gaussian" else []
    loss = BehavioralMetricLoss(encoder, *dynamics, divergence=divergence, gamma=gamma)
    updater = SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    observation = torch.randn(samples + 1, OBSERVATION_DIM)
    data = TensorDict(
        {
            "observation": observation[:-1],
            "next": {
                "observation": observation[1:],
                "reward": observation[:-1, :1],
                "terminated": torch.rand(samples, 1) < 0.05,
            },
        },
        [samples],
    )
    for _ in range(600):
        out = loss(data)
        optimizer.zero_grad()
        sum(value for key, value in out.items() if key.startswith("loss_")).backward()
        optimizer.step()
        updater.step()
    # No pseudometric exceeds the largest difference of rewards, discounted over all time.
    bound = (data["next", "reward"].max() - data["next", "reward"].min()) / (1 - gamma)
    assert 0.5 < out["mean_distance"] < bound
    assert out["effective_rank"] > 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"divergence": "w2"}, "divergence is 'w2'; choose one of sampled, gaussian"),
        ({"distance": "cosine"}, "choose one of l2, mico"),
        ({"regularizer": "paper"}, "choose one of hinge, literal, none"),
        ({"pairs": "some"}, "choose one of permuted, all"),
        ({"divergence": "gaussian"}, "pass GaussianDynamics"),
        ({"dynamics": GaussianDynamics(2)}, "does not read it"),
        (
            {"dynamics": GaussianDynamics(2), "divergence": "gaussian", "distance": "mico"},
            "choose distance='l2'",
        ),
        ({"gamma": 1.0}, "gamma is 1.0"),
        ({"weight": -1.0}, "weight is -1.0"),
        ({"epsilon": -1.0}, "epsilon is -1.0"),
        ({"delay_encoder": "no"}, "delay_encoder is 'no'; it must be true or false"),
    ],
)
def test_wrong_options_are_refused_at_construction(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BehavioralMetricLoss(table(*ROWS), **options)


def test_plain_networks_are_refused() -> None:
    with pytest.raises(TypeError, match="encoder is a Linear; pass a TensorDictModuleBase"):
        BehavioralMetricLoss(nn.Linear(2, 2))


@pytest.mark.parametrize("key", ["reward", "terminated"])
@pytest.mark.parametrize("shape", [[8], [8, 2]])
def test_entries_that_are_not_one_number_a_state_are_refused(key: str, shape: list[int]) -> None:
    batch = TensorDict({"observation": torch.rand(8, 3)}, [8])
    batch["next"] = batch.clone().set("reward", torch.rand(8, 1))
    batch["next", "terminated"] = torch.zeros(8, 1, dtype=torch.bool)
    wrong = batch["next", key].new_zeros(shape)
    batch["next", key] = wrong
    loss = BehavioralMetricLoss(StateEncoder(3, 2))
    with pytest.raises(ValueError, match=rf"'{key}'\) has shape \{shape}.*must be \[\*, 1\]"):
        loss(batch)


def test_batch_of_one_transition_is_refused() -> None:
    with pytest.raises(ValueError, match="at least two"):
        BehavioralMetricLoss(table(*ROWS))(transitions([0], [1], [0.0], [False], 3))
