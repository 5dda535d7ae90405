"""EME: its loss against the check list of losses, values worked out by hand and a fixed point."""

# ruff: noqa: RUF012  (class attributes that configure a check list are constants)

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.data import Bounded
from torchrl.modules import Delta, ProbabilisticActor, TanhNormal
from torchrl.objectives import SoftUpdate

from tests.lookup_tables import Lookup, table, transitions
from tests.loss_checks import LossChecks
from tests.point_env import ACTION_DIM, OBSERVATION_DIM
from torchrl_etl.baselines import EMELoss, RewardEnsemble
from torchrl_etl.modules import StateEncoder, make_actor
from torchrl_etl.objectives import FusedSoftUpdate

K = 3


def fixed(build: Any, *args: Any, **kwargs: Any) -> Any:
    """``build(...)`` with the same weights in every process, whatever the seed."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return build(*args, **kwargs)


# The loss


class TestEMELoss(LossChecks):
    default_keys = {"reward": "reward", "terminated": "terminated"}
    targets = {"target_encoder_params"}
    recorded = {("next", "observation"), ("next", "reward")}
    trained = {"loss_metric": {"encoder_params"}, "loss_reward_ensemble": {"ensemble_params"}}
    options: dict[str, Any] = {}

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> EMELoss:
        def at(name: str) -> Any:
            return ("agent", name) if nested else name

        hidden = (16, 16)
        encoder = StateEncoder(OBSERVATION_DIM, K, hidden=hidden, in_keys=[at("observation")])
        keys = [at("observation"), at("action")]
        ensemble = RewardEnsemble(OBSERVATION_DIM, ACTION_DIM, 4, hidden=hidden, in_keys=keys)
        # The actor is not in the loss's state dict, so its weights must not depend on the seed.
        actor = fixed(
            make_actor,
            {at("observation"): OBSERVATION_DIM},
            Bounded(-1, 1, shape=(ACTION_DIM,)),
            hidden=hidden,
        )
        with torch.no_grad():
            actor[0].module[-2].weight.mul_(100)  # a new actor is nearly constant
        loss = EMELoss(encoder, ensemble, actor, **self.options | kwargs)
        if nested:
            loss.set_keys(reward=at("reward"), terminated=at("over"))
        return loss

    def make_data(self, batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
        observation, following = torch.randn(2, *batch, OBSERVATION_DIM)
        root = {"observation": observation, "action": torch.rand(*batch, ACTION_DIM)}
        after = {"observation": following, "reward": torch.randn(*batch, 1)}
        after["over" if nested else "terminated"] = torch.rand(*batch, 1) < 0.2
        if nested:
            root, after = {"agent": root}, {"agent": after}
        return TensorDict(root | {"next": TensorDict(after, batch)}, batch)

    def test_policy_gets_no_gradient_and_is_no_parameter(self) -> None:
        loss = self.built()
        sum(self.losses(loss(self.data())).values()).backward()
        assert all(parameter.grad is None for parameter in loss.actor.parameters())
        assert {name.split(".")[0] for name, _ in loss.named_parameters()} == {
            "encoder_params",
            "ensemble_params",
        }
        assert not any("actor" in name for name in loss.state_dict())

    def test_reset_dtype_and_mode_of_the_loss_leave_the_policy_alone(self) -> None:
        loss = self.built()
        before = copy.deepcopy(dict(loss.actor.state_dict()))
        loss.actor.train()
        loss.eval().double().reset_parameters_recursive()
        assert loss.actor.training
        for name, value in loss.actor.state_dict().items():
            assert value.dtype == before[name].dtype and torch.equal(value, before[name])

    def test_loss_reads_the_current_policy_weights(self) -> None:
        loss, data = self.built(), self.data()
        before = self.seeded(loss, data)["mean_policy_divergence"]
        with torch.no_grad():
            loss.actor[0].module[-2].weight.mul_(2)
        assert self.seeded(loss, data)["mean_policy_divergence"] > 1.5 * before


class TestCorrected(TestEMELoss):
    options = {"reward_difference": "corrected", "loss_function": "l2", "subset_share": 1.0}


# Numbers on lookup tables


class Gaussian(Lookup):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return super().forward(observation).chunk(2, -1)


def predictors(rows: list[list[float]]) -> TensorDictModule:
    keys = ["observation", "action"]
    return TensorDictModule(Lookup(rows), in_keys=keys, out_keys=["reward_prediction"])


def policy(loc: list[list[float]], scale: list[list[float]]) -> ProbabilisticActor:
    rows = [[*mean, *deviation] for mean, deviation in zip(loc, scale, strict=True)]
    return ProbabilisticActor(
        TensorDictModule(Gaussian(rows), in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )


ROWS = [[0.0, 0.0], [3.0, 4.0], [0.0, 6.0]]
D01, D02, D12 = 5.0, 6.0, 13**0.5
LOC, SCALE = [[0.0], [1.0], [3.0]], [[1.0], [2.0], [0.5]]
PREDICTIONS = [[0.0, 2.0], [1.0, 1.0], [0.0, 1.0]]  # variances 1, 0, 1/4


def loss_of_tables(**options: Any) -> EMELoss:
    options = {"gamma": 0.5, "loss_function": "l2", "subset_share": 1.0} | options
    return EMELoss(table(*ROWS), predictors(PREDICTIONS), policy(LOC, SCALE), **options)


def kl(i: int, j: int) -> float:
    mean, deviation = LOC[i][0] - LOC[j][0], SCALE[i][0] / SCALE[j][0]
    return (deviation**2 + (mean / SCALE[j][0]) ** 2 - 1) / 2 - math.log(deviation)


def test_policy_divergence_equals_torchs_kl() -> None:
    loc, scale = torch.randn(2, 6), 0.1 + torch.rand(2, 6)
    actor = policy(loc.tolist(), scale.tolist())
    loss = EMELoss(table(*ROWS[:2]), predictors(PREDICTIONS[:2]), actor)
    out = loss(transitions([0, 1], [1, 0], [0.0, 0.0], [False, False], 2))
    first, second = (Independent(Normal(*row), 1) for row in zip(loc, scale, strict=True))
    expected = (kl_divergence(first, second) + kl_divergence(second, first)) / 2
    torch.testing.assert_close(out["mean_policy_divergence"], expected)


def test_kl_of_gaussians_equals_kl_of_squashed_policies() -> None:
    pairs = zip(LOC[:2], SCALE[:2], strict=True)
    first, second = (TanhNormal(torch.tensor(loc), torch.tensor(scale)) for loc, scale in pairs)
    action = first.sample((100_000,))
    sampled = (first.log_prob(action) - second.log_prob(action)).mean()
    assert sampled.item() == pytest.approx(kl(0, 1), abs=0.01)


@pytest.mark.parametrize("policy_weight", [1.0, 0.5])
def test_targets_of_three_rows_by_hand(policy_weight: float) -> None:
    # State i goes to i + 1; rewards 2, 1, 5.
    data = transitions([0, 1, 2], [1, 2, 0], [2.0, 1.0, 5.0], [False] * 3, 3)
    loss = loss_of_tables(policy_weight=policy_weight, reduction="none")
    onward = [
        D01 - (1 + 0.5 * D12 + policy_weight * kl(0, 1)),
        D12 - (4 + 0.5 * D02 + policy_weight * kl(1, 2)),
        D02 - (3 + 0.5 * D01 + policy_weight * kl(2, 0)),
    ]
    backward = [
        D02 - (3 + 0.5 * D01 + policy_weight * kl(0, 2)),
        D01 - (1 + 0.5 * D12 + policy_weight * kl(1, 0)),
        D12 - (4 + 0.5 * D02 + policy_weight * kl(2, 1)),
    ]
    # Three samples have only two pairings in which none meets itself.
    expected = [torch.tensor(errors).square() for errors in (onward, backward)]
    seen = set()
    for _ in range(20):
        out = loss(data)["loss_metric"]
        found = [i for i, each in enumerate(expected) if torch.allclose(out, each, rtol=1e-4)]
        assert len(found) == 1
        seen.update(found)
    assert seen == {0, 1}


@pytest.mark.parametrize(
    ("ended", "future"),
    [([True, True], 0.0), ([True, False], 6.0), ([False, True], 5.0), ([False, False], D12)],
)
def test_ended_episodes_share_one_absorbing_state(ended: list[bool], future: float) -> None:
    loss = loss_of_tables(policy_weight=0.0)
    out = loss(transitions([0, 1], [1, 2], [0.0, 0.0], ended, 3))
    assert out["loss_metric"].item() == pytest.approx((5 - 0.5 * future) ** 2, rel=1e-4)


def test_smooth_l1_is_linear_for_large_errors() -> None:
    loss = loss_of_tables(loss_function="smooth_l1", policy_weight=0.0)
    out = loss(transitions([0, 1], [1, 2], [2.0, 1.0], [False, False], 3))
    assert out["loss_metric"].item() == pytest.approx(5 - 1 - 0.5 * D12 - 0.5, rel=1e-4)


@pytest.mark.parametrize(("reward", "left"), [(2.0, 3**0.5), (1.0, 0.0), (0.5, 0.0)])
def test_corrected_reward_difference_subtracts_the_variances(reward: float, left: float) -> None:
    # The members' variances at states 0 and 1 are 1 and 0.
    loss = loss_of_tables(reward_difference="corrected")
    out = loss(transitions([0, 1], [1, 2], [reward, 0.0], [False, False], 3))
    assert out["mean_reward_difference"].item() == pytest.approx(left, abs=1e-6)


def test_ensemble_loss_and_variance_by_hand() -> None:
    out = loss_of_tables()(transitions([0, 1, 2], [1, 2, 0], [1.0, 3.0, 1.0], [False] * 3, 3))
    # Errors (1, 1), (2, 2), (1, 0).
    assert out["loss_reward_ensemble"].item() == pytest.approx((1 + 4 + 0.5) / 3)
    assert out["mean_reward_variance"].item() == pytest.approx((1 + 0 + 0.25) / 3)


def test_random_subsets_keep_the_expected_ensemble_loss() -> None:
    count = 4_000
    data = transitions([0] * count, [1] * count, [1.0] * count, [False] * count, 3)
    whole = loss_of_tables(reduction="none")(data)["loss_reward_ensemble"]
    part = loss_of_tables(subset_share=0.25, reduction="none")(data)["loss_reward_ensemble"]
    assert part.mean().item() == pytest.approx(whole.mean().item(), rel=0.05)
    # Of two members with error 1, a sample is drawn by both, one or none, with weight 4.
    assert set(part.tolist()) == {0.0, 2.0, 4.0}
    assert (part == 4.0).float().mean().item() == pytest.approx(1 / 16, abs=0.02)


def test_distances_on_a_cycle_converge_to_the_fixed_point() -> None:
    # 0 -> 1 -> 2 -> 0 with rewards 0, 1, 2; divergences 1/2, 1/2 and 0, the same both ways.
    actor = policy([[0.0], [1.0], [0.0]], [[1.0]] * 3)
    encoder = table(*(0.1 * torch.randn(3, 2)).tolist())
    loss = EMELoss(encoder, predictors(PREDICTIONS), actor, gamma=0.5, loss_function="l2")
    updater = FusedSoftUpdate(loss, tau=0.05)
    data = transitions([0, 1, 2], [1, 2, 0], [0.0, 1.0, 2.0], [False] * 3, 3)
    optimizer = torch.optim.Adam(loss.encoder_params.parameters(), 2e-2)
    for _ in range(600):
        optimizer.zero_grad()
        loss(data)["loss_metric"].backward()
        optimizer.step()
        updater.step()
    # d01 = 1.5 + d12 / 2, d12 = 1.5 + d20 / 2, d20 = 2 + d01 / 2
    system = torch.tensor([[1.0, -0.5, 0.0], [0.0, 1.0, -0.5], [-0.5, 0.0, 1.0]])
    expected = torch.linalg.solve(system, torch.tensor([1.5, 1.5, 2.0]))
    rows = encoder.module.rows.detach()
    torch.testing.assert_close((rows - rows.roll(-1, 0)).norm(dim=-1), expected, rtol=0.02, atol=0)


@pytest.mark.parametrize(("gamma", "times"), [(0.95, 20), (0.99, 100), (0.0, 1)])
def test_constant_divergence_c_gives_distance_c_over_one_minus_gamma(
    gamma: float, times: int
) -> None:
    """d = c + gamma d: no reward, two states that never change, KL of N(0, 1) and N(2, 1) is 2."""
    actor = policy([[0.0], [2.0]], [[1.0], [1.0]])
    data = transitions([0, 1], [0, 1], [0.0, 0.0], [False, False], 2)
    for distance, error in ((2.0 * times, 0.0), (2.0 * times + 1, (1 - gamma) ** 2)):
        encoder = table([0.0], [distance])
        out = EMELoss(encoder, predictors([[0.0], [0.0]]), actor, gamma=gamma, loss_function="l2")(
            data
        )
        assert out["mean_policy_divergence"].item() == pytest.approx(2.0)
        assert out["loss_metric"].item() == pytest.approx(error, abs=1e-6)


def test_ensemble_variance_is_low_only_on_trained_data() -> None:
    ensemble = RewardEnsemble(2, 1, hidden=(32,))
    actor = policy([[0.0]] * 2, [[1.0]] * 2)
    loss = EMELoss(StateEncoder(2, 2, hidden=(8,)), ensemble, actor)
    SoftUpdate(loss, tau=0.1)
    data = transitions([0, 1] * 32, [1, 0] * 32, [1.0, -1.0] * 32, [False] * 64, 2)
    data["observation"] += 0.1 * torch.randn(64, 2)
    optimizer = torch.optim.Adam(loss.ensemble_params.parameters(), 1e-2)
    for _ in range(200):
        optimizer.zero_grad()
        loss(data)["loss_reward_ensemble"].backward()
        optimizer.step()

    def variance(observation: torch.Tensor) -> float:
        out = ensemble(TensorDict({"observation": observation, "action": data["action"]}, [64]))
        return out["reward_prediction"].var(-1).mean().item()

    assert variance(5 * torch.randn(64, 2)) > 30 * variance(data["observation"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reward_difference": "squared"}, "choose one of sampled, corrected"),
        ({"loss_function": "l1"}, "loss_function is 'l1'; choose one of smooth_l1, l2"),
        ({"gamma": 1.0}, "gamma is 1.0"),
        ({"policy_weight": -1.0}, "policy_weight is -1.0"),
        ({"subset_share": 0.0}, "subset_share is 0.0"),
        ({"subset_share": 1.1}, "subset_share is 1.1"),
    ],
)
def test_wrong_options_are_refused_at_construction(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        loss_of_tables(**options)


def test_actor_without_a_scale_is_refused() -> None:
    networks = table(*ROWS), predictors(PREDICTIONS)
    deterministic = ProbabilisticActor(
        TensorDictModule(nn.Linear(2, 1), in_keys=["observation"], out_keys=["loc"]),
        in_keys={"param": "loc"},
        distribution_class=Delta,
    )
    with pytest.raises(ValueError, match="it must write its Gaussian's mean"):
        EMELoss(*networks, deterministic)


def test_plain_networks_are_refused() -> None:
    parts = table(*ROWS), predictors(PREDICTIONS), policy(LOC, SCALE)
    for index, name in enumerate(("encoder", "ensemble", "actor")):
        wrong = [nn.Linear(2, 2) if i == index else part for i, part in enumerate(parts)]
        with pytest.raises(TypeError, match=f"{name} is a Linear"):
            EMELoss(*wrong)


def test_batch_of_one_transition_is_refused() -> None:
    with pytest.raises(ValueError, match="at least two"):
        loss_of_tables()(transitions([0], [1], [0.0], [False], 3))


@pytest.mark.parametrize("key", ["reward", "terminated"])
def test_missing_or_misshapen_entries_are_named(key: str) -> None:
    actor = make_actor({"observation": OBSERVATION_DIM}, Bounded(-1, 1, shape=(ACTION_DIM,)))
    ensemble = RewardEnsemble(OBSERVATION_DIM, ACTION_DIM, 2)
    loss = EMELoss(StateEncoder(OBSERVATION_DIM, 2), ensemble, actor)
    entries = {"observation": torch.rand(8, OBSERVATION_DIM), "action": torch.rand(8, ACTION_DIM)}
    data = TensorDict({**entries, "next": {"observation": entries["observation"]}}, [8])
    data["next", "reward"] = torch.rand(8, 1)
    data["next", "terminated"] = torch.zeros(8, 1, dtype=torch.bool)
    loss(data)
    with pytest.raises(KeyError, match=rf"EMELoss reads \('next', '{key}'\), which the data lacks"):
        loss(data.exclude(("next", key)))
    for shape in ([8], [8, 2]):
        wrong = data.clone().set(("next", key), data["next", key].new_zeros(shape))
        with pytest.raises(ValueError, match=rf"'{key}'\) has shape .* must be \[\*, 1\]"):
            loss(wrong)
