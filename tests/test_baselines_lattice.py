"""Lattice: the covariance, the squashed density, and the actor in SAC."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import MultivariateNormal
from torchrl.data import Bounded
from torchrl.objectives.sac import compute_rsample_log_prob

from tests import test_objectives_synergy_sac as synergy
from torchrl_etl.baselines.lattice import (
    LatticeNormal,
    StateDependentSpread,
    lattice_scale_tril,
    make_lattice_actor,
)
from torchrl_etl.modules import make_actor, make_critic
from torchrl_etl.objectives import LeanSACLoss

LOW, HIGH = torch.tensor([0.0, -1.0, -3.0]), torch.tensor([1.0, 1.0, 5.0])
SPEC = Bounded(LOW, HIGH, shape=(3,))
KINDS = [{"state_dependent": False}, {"state_dependent": True}]


@pytest.fixture(autouse=True)
def seed() -> None:
    torch.manual_seed(0)


def actor_on(spec: Bounded = SPEC, **kwargs: Any) -> Any:
    return make_lattice_actor({"observation": 4}, spec, hidden=(6,), **kwargs)


def observations(*rows: int) -> TensorDict:
    return TensorDict({"observation": torch.randn(*rows, 4)}, rows)


def gaussian(dim: int = 3, rows: int = 5, dtype: torch.dtype = torch.float64) -> tuple[Tensor, ...]:
    root = torch.randn(rows, dim, dim, dtype=dtype)
    return torch.randn(rows, dim, dtype=dtype), torch.linalg.cholesky(
        root @ root.mT + 0.1 * torch.eye(dim, dtype=dtype)
    )


# Covariance


def test_covariance_by_hand() -> None:
    # W diag(4, 9) Wᵀ = [[4+36, 12-18], [12-18, 36+9]], plus diag(0.25, 1).
    weight = torch.tensor([[1.0, 2.0], [3.0, -1.0]], dtype=torch.float64)
    lower = lattice_scale_tril(
        weight,
        torch.tensor([4.0, 9.0], dtype=torch.float64),
        torch.tensor([0.25, 1.0], dtype=torch.float64),
    )
    expected = torch.tensor([[40.25, -6.0], [-6.0, 46.0]], dtype=torch.float64)
    torch.testing.assert_close(lower @ lower.mT, expected, rtol=1e-12, atol=1e-12)
    assert torch.equal(lower, lower.tril())


def test_covariance_is_that_of_noise_through_the_last_layer() -> None:
    weight, latent, action = torch.randn(3, 6), torch.rand(6), torch.rand(3)
    lower = lattice_scale_tril(weight, latent, action)
    count = 200_000
    noise = torch.randn(count, 6) * latent.sqrt() @ weight.T + torch.randn(count, 3) * action.sqrt()
    torch.testing.assert_close(lower @ lower.mT, noise.T.cov(), rtol=0.02, atol=0.02)


@pytest.mark.parametrize("rows", [(), (2,), (2, 3)])
def test_every_row_has_its_own_covariance(rows: tuple[int, ...]) -> None:
    weight = torch.randn(3, 6, dtype=torch.float64)
    latent, action = torch.rand(*rows, 6).double(), torch.rand(*rows, 3).double()
    lower = lattice_scale_tril(weight, latent, action)
    expected = weight @ torch.diag_embed(latent) @ weight.T + torch.diag_embed(action)
    torch.testing.assert_close(lower @ lower.mT, expected)


@pytest.mark.parametrize("width", [1.0, 30.0, 1e4])
def test_single_precision_survives_actuators_that_move_as_one(width: float) -> None:
    weight = width * torch.ones(80, 1) @ torch.rand(1, 256) + 1e-4 * torch.randn(80, 256)
    weight.requires_grad_()
    lower = lattice_scale_tril(weight, torch.rand(16, 256), torch.full((16, 80), 1e-6))
    lower.square().sum().backward()
    assert lower.isfinite().all() and weight.grad.isfinite().all()
    exact = weight.double().square() @ torch.ones(256).double()
    scale = lower.detach().square().sum(-1) / exact
    assert (scale < 1).all() and (scale > 0.2).all()  # mean variance of a feature: a half


def test_gradients_reach_w_and_both_variances() -> None:
    leaves = [torch.randn(3, 6), torch.rand(4, 6) + 0.1, torch.rand(4, 3) + 0.1]
    leaves = [leaf.double().requires_grad_() for leaf in leaves]
    assert torch.autograd.gradcheck(lattice_scale_tril, leaves)


# Distribution


def test_log_prob_is_the_gaussians_with_change_of_variables() -> None:
    loc, lower = gaussian()
    low, high = LOW.double(), HIGH.double()
    normal = LatticeNormal(loc, lower, low=low, high=high)
    latent = torch.randn(7, 5, 3, dtype=torch.float64)
    action = low + (latent.tanh() + 1) / 2 * (high - low)
    slope = (1 - latent.tanh().square()) * (high - low) / 2
    expected = MultivariateNormal(loc, scale_tril=lower).log_prob(latent) - slope.log().sum(-1)
    torch.testing.assert_close(normal.log_prob(action), expected)
    assert (normal.batch_shape, normal.event_shape) == ((5,), (3,))


def test_density_integrates_to_one() -> None:
    lower = torch.tensor([[0.5, 0.0], [0.4, 0.3]], dtype=torch.float64)
    normal = LatticeNormal(torch.tensor([0.3, -0.2], dtype=torch.float64), lower, low=-2.0)
    sides = [torch.linspace(low, 1, 1002, dtype=torch.float64)[1:-1] for low in (-2, -2)]
    points = torch.cartesian_prod(*sides)
    mass = normal.log_prob(points).exp().sum() * (3 / 1001) ** 2
    torch.testing.assert_close(mass.item(), 1.0, rtol=1e-3, atol=0)


def test_drawn_actions_are_scored_as_log_prob_scores_them() -> None:
    loc, lower = gaussian()
    normal = LatticeNormal(loc, lower, low=LOW, high=HIGH)
    action, log_prob = normal.rsample_and_log_prob((100,))
    torch.testing.assert_close(log_prob, normal.log_prob(action), rtol=1e-5, atol=1e-5)
    assert (action >= LOW).all() and (action <= HIGH).all()


def test_gradient_of_a_drawn_score_is_that_of_log_prob_along_the_draw() -> None:
    loc, lower = (leaf.requires_grad_() for leaf in gaussian(rows=1))
    normal = LatticeNormal(loc, lower)
    torch.manual_seed(1)
    direct = torch.autograd.grad(normal.rsample_and_log_prob()[1].sum(), (loc, lower))
    torch.manual_seed(1)
    latent = loc + (lower @ torch.randn(1, 3, 1, dtype=torch.float64)).squeeze(-1)
    gaussian_score = MultivariateNormal(loc, scale_tril=lower).log_prob(latent)
    score = gaussian_score - (1 - latent.tanh().square()).log().sum(-1)
    through = torch.autograd.grad(score.sum(), (loc, lower))
    for one, other in zip(direct, through, strict=True):
        # Only the lower triangle is the distribution's.
        torch.testing.assert_close(*((one.tril(), other.tril()) if one.ndim == 3 else (one, other)))


def test_scores_are_finite_at_and_near_the_bounds() -> None:
    loc = torch.tensor([[40.0, -40.0]], requires_grad=True)
    normal = LatticeNormal(loc, 1e-3 * torch.eye(2).expand(1, 2, 2))
    action, log_prob = normal.rsample_and_log_prob()
    log_prob.sum().backward()
    assert action.abs().max() < 1 and log_prob.isfinite().all() and loc.grad.isfinite().all()
    corners = torch.tensor([[1.0, -1.0]])
    assert normal.log_prob(corners).isfinite().all()
    # At 40 the slope of tanh is 4 exp(-80): 80 - ln 4 for each of two, and the Gaussian's ~ 10.
    assert 140 < log_prob.item() < 190


def test_samples_have_the_covariance_before_the_tanh() -> None:
    loc, lower = gaussian(dim=2, rows=1)
    lower = 0.3 * lower
    action = LatticeNormal(loc, lower).sample((200_000,))[:, 0]
    covariance = action.atanh().T.cov()
    torch.testing.assert_close(covariance, (lower @ lower.mT)[0], rtol=0.03, atol=0.005)


def test_deterministic_sample_is_the_squashed_mean() -> None:
    loc, lower = gaussian()
    normal = LatticeNormal(loc, lower, low=LOW, high=HIGH)
    expected = LOW + (loc.tanh() + 1) / 2 * (HIGH - LOW)
    torch.testing.assert_close(normal.deterministic_sample, expected)


def test_bounds_out_of_order_are_refused() -> None:
    loc, lower = gaussian()
    with pytest.raises(ValueError, match="every lower bound must be below"):
        LatticeNormal(loc, lower, low=1.0, high=torch.tensor([1.0, 2.0, 3.0]))


# Actor


def covariance_of(actor: Any, data: TensorDict) -> Tensor:
    lower = actor.get_dist(data).base_dist.scale_tril
    return lower @ lower.mT


def test_actor_has_the_printed_covariance() -> None:
    actor, data = actor_on(log_std_init=-1.0).double(), observations(5).double()
    network = actor[0].module
    features = network.features(data["observation"])
    sigma = network.spread.head(features).clamp(-20, 2).exp()
    weight = network.mean.weight
    expected = weight @ torch.diag_embed(sigma[:, :6].square()) @ weight.T
    expected = expected + torch.diag_embed(sigma[:, 6:].square())
    torch.testing.assert_close(covariance_of(actor, data), expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("raw", "variance"),
    # W's rows are unit vectors: a diagonal entry is a feature's variance plus an actuator's.
    [
        (1.0, 2 * math.exp(2)),
        (2.0, 2 * math.exp(4)),
        (9.0, 2 * math.exp(4)),
        (-3, 2 * math.exp(-6)),
    ],
)
def test_plain_spread_is_bounded_as_its_authors_bound_it(raw: float, variance: float) -> None:
    actor = make_lattice_actor({"observation": 4}, SPEC, hidden=(8,))
    network = actor[0].module
    with torch.no_grad():
        network.mean.weight.copy_(torch.eye(3, 8))
        network.spread.head.weight.zero_()
        network.spread.head.bias.fill_(raw)
    covariance = covariance_of(actor, observations(1))[0]
    torch.testing.assert_close(covariance, variance * torch.eye(3), rtol=1e-4, atol=1e-6)
    assert raw != 1.0 or round(variance, 2) == 14.78


def test_state_dependent_spread_may_grow_to_ten_as_its_authors_have_it() -> None:
    spread = actor_on(state_dependent=True)[0].module.spread
    assert [round(math.exp(bound), 6) for bound in spread.bounds] == [0.001, 10.0]


def test_state_dependent_actor_has_the_printed_covariance() -> None:
    actor = actor_on(state_dependent=True, alpha=0.7, std_reg=0.1, log_std_bounds=(-3.0, 2.0))
    actor, data = actor.double(), observations(5).double()
    network = actor[0].module
    with torch.no_grad():
        network.spread.log_std.copy_(3 * torch.randn(6, 9))
    log_std = network.spread.log_std.clamp(-3, 2) - 0.5 * math.log(6)
    std = torch.where(log_std > 0, (log_std.clamp_min(0) + 1).log() + 1, log_std.exp())
    assert (log_std > 0).any() and (log_std < 0).any()
    squares, weight = network.features(data["observation"]).square(), network.mean.weight
    latent, action = squares @ std[:, :6].square(), squares @ std[:, 6:].square() + 0.01
    expected = 0.49 * weight @ torch.diag_embed(latent) @ weight.T + torch.diag_embed(action)
    torch.testing.assert_close(covariance_of(actor, data), expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_spread_starts_at_the_asked_value_and_stays_in_its_bounds(kind: dict[str, bool]) -> None:
    actor = actor_on(**kind, log_std_init=-2.0, log_std_bounds=(-3.0, 0.0), std_reg=0.0)
    network = actor[0].module
    features = torch.ones(1, 6)

    def log_std() -> Tensor:  # with all features one, 1/H is undone by the sum over H
        return 0.5 * torch.cat(network.spread(features), -1).log()

    torch.testing.assert_close(log_std(), torch.full((1, 9), -2.0), atol=0.05, rtol=0)
    for push, bound in ((100.0, 0.0), (-200.0, -3.0)):
        with torch.no_grad():
            for parameter in network.spread.parameters():
                parameter.add_(push)
        torch.testing.assert_close(log_std(), torch.full((1, 9), bound), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("push", "sign"), [(100.0, 1), (-100.0, -1)])
def test_a_spread_beyond_its_bounds_can_come_back(push: float, sign: int) -> None:
    spread = StateDependentSpread(4, 2, init=0.0, bounds=(-3.0, 0.0), alpha=1.0, std_reg=0.0)
    with torch.no_grad():
        spread.log_std.add_(push)
    for direction in (1, -1):  # of descent
        (gradient,) = torch.autograd.grad(
            -direction * sum(part.sum() for part in spread(torch.ones(4))), spread.log_std
        )
        assert bool((gradient != 0).all()) == (direction == -sign)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_reach_every_part_of_the_actor(kind: dict[str, bool]) -> None:
    actor = actor_on(**kind, log_std_init=-1.0)
    for pick in (0, 1):  # action, log-probability
        actor.zero_grad()
        compute_rsample_log_prob(actor.get_dist(observations(32)))[pick].sum().backward()
        for name, parameter in actor.named_parameters():
            assert parameter.grad.abs().sum() > 0, name


def test_log_prob_moves_w_through_the_covariance() -> None:
    actor, data = actor_on(log_std_init=-1.0), observations(8)
    network = actor[0].module
    dist = actor.get_dist(data)
    torch.testing.assert_close(
        dist.base_dist.loc, network.mean(network.features(data["observation"]))
    )
    fixed = LatticeNormal(dist.base_dist.loc.detach(), dist.base_dist.scale_tril)
    fixed.log_prob(torch.zeros(8, 3)).sum().backward()
    assert network.mean.weight.grad.abs().sum() > 0 and network.mean.bias.grad is None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("body", ["mlp", "residual"])
def test_actions_fill_the_bounds_and_stay_inside(kind: dict[str, bool], body: str) -> None:
    actor = actor_on(**kind, body=body)
    action = actor(observations(5000))["action"]
    assert SPEC.is_in(action[0]) and (action >= LOW).all() and (action <= HIGH).all()
    height = (action - LOW) / (HIGH - LOW)
    assert (height.amin(0) < 0.1).all() and (height.amax(0) > 0.9).all()
    assert actor.spec["action"] == SPEC


def test_same_call_as_make_actor_with_several_and_nested_keys() -> None:
    inputs = {("agent", "observation"): 4, "direction": 2}
    data = TensorDict(
        {"agent": {"observation": torch.randn(5, 4)}, "direction": torch.randn(5, 2)}, [5]
    )
    common = {"out_key": ("agent", "action"), "body": "mlp", "hidden": (8,), "layer_norm": False}
    for make in (make_actor, make_lattice_actor):
        actor = make(inputs, SPEC, **common)
        assert actor.in_keys == list(inputs) and actor.dist_sample_keys == [("agent", "action")]
        assert actor(data.clone())["agent", "action"].shape == (5, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hidden": ()}, "hidden is empty"),
        ({"log_std_bounds": (0.0, -1.0)}, "low < high"),
        ({"log_std_init": 3.0}, "low <= log_std_init <= high"),
        ({"log_std_bounds": 2.0}, "pass a pair"),
        ({"alpha": -1.0}, "neither may be negative"),
        ({"std_reg": -1.0}, "neither may be negative"),
        ({"body": "conv"}, "choose one of mlp, residual"),
    ],
)
def test_bad_input_is_refused_at_construction(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_lattice_actor({"observation": 4}, SPEC, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_state_dict_round_trip_gives_the_same_distribution(kind: dict[str, bool]) -> None:
    one, other, data = actor_on(**kind), actor_on(**kind), observations(5)
    assert not torch.equal(covariance_of(one, data), covariance_of(other, data))
    other.load_state_dict(one.state_dict())
    assert torch.equal(covariance_of(one, data), covariance_of(other, data))


@pytest.mark.parametrize("kind", KINDS)
def test_follows_its_module_to_another_precision(kind: dict[str, bool]) -> None:
    actor = actor_on(**kind).double()
    assert actor(observations(5).double())["action"].dtype == torch.float64
    assert actor.float()(observations(5))["action"].dtype == torch.float32


# In SAC


class TestLatticeSAC(synergy.TestSynergySACLoss):
    """LeanSACLoss on a Lattice actor passes the check list of losses."""

    default_keys = synergy.TestSynergySACLoss.default_keys | {"action": "action"}
    trained = synergy.TestSynergySACLoss.trained | {"loss_actor": {"actor_network_params"}}
    state_dependent = False

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> LeanSACLoss:
        def at(name: str) -> Any:
            return ("agent", name) if nested else name

        spec = Bounded(0.0, 1.0, shape=(synergy.ACTION,))
        loss = LeanSACLoss(
            make_lattice_actor(
                {at("observation"): synergy.OBSERVATION},
                spec,
                out_key=at("action"),
                hidden=(16, 16),
                state_dependent=self.state_dependent,
                log_std_init=-1.0,
            ),
            make_critic(
                {at("observation"): synergy.OBSERVATION, at("action"): synergy.ACTION},
                hidden=(16, 16),
            ),
            **{"target_entropy": -1.0, **kwargs},
        )
        if nested:
            loss.set_keys(**{name: at(name) for name in ("reward", "done", "terminated")})
        loss.make_value_estimator(gamma=synergy.GAMMA)
        return loss


class TestStateDependentLatticeSAC(TestLatticeSAC):
    state_dependent = True
