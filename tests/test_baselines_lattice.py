"""Lattice: its actor, alone and in SAC."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded
from torchrl.objectives.sac import compute_rsample_log_prob

from tests import test_objectives_sac as plain
from torchrl_etl.baselines.lattice import LatticeNormal, StateDependentSpread, make_lattice_actor
from torchrl_etl.objectives import LeanSACLoss

LOW, HIGH = torch.tensor([0.0, -1.0, -3.0]), torch.tensor([1.0, 1.0, 5.0])
SPEC = Bounded(LOW, HIGH, shape=(3,))
KINDS = [{"state_dependent": False}, {"state_dependent": True}]


def actor_on(spec: Bounded = SPEC, **kwargs: Any) -> Any:
    return make_lattice_actor({"observation": 4}, spec, hidden=(6,), **kwargs)


def observations(*rows: int) -> TensorDict:
    return TensorDict({"observation": torch.randn(*rows, 4)}, rows)


# Actor


def covariance_of(actor: Any, data: TensorDict) -> Tensor:
    lower = actor.get_dist(data).base_dist.scale_tril
    return lower @ lower.mT


def test_actor_has_the_papers_covariance() -> None:
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
def test_plain_log_std_has_the_authors_bounds(raw: float, variance: float) -> None:
    actor = make_lattice_actor({"observation": 4}, SPEC, hidden=(8,))
    network = actor[0].module
    with torch.no_grad():
        network.mean.weight.copy_(torch.eye(3, 8))
        network.spread.head.weight.zero_()
        network.spread.head.bias.fill_(raw)
    covariance = covariance_of(actor, observations(1))[0]
    torch.testing.assert_close(covariance, variance * torch.eye(3), rtol=1e-4, atol=1e-6)


def test_state_dependent_std_has_the_authors_bounds() -> None:
    spread = actor_on(state_dependent=True)[0].module.spread
    assert [round(math.exp(bound), 6) for bound in spread.bounds] == [0.001, 10.0]


def test_state_dependent_actor_has_the_papers_covariance() -> None:
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
def test_log_std_starts_at_its_init_and_stays_in_its_bounds(kind: dict[str, bool]) -> None:
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
def test_log_std_beyond_its_bounds_gets_a_gradient_inwards(push: float, sign: int) -> None:
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


def test_log_prob_reaches_the_last_layer_through_the_covariance() -> None:
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hidden": ()}, "hidden is empty"),
        ({"log_std_bounds": (0.0, -1.0)}, "low < high"),
        ({"log_std_init": 3.0}, "low <= log_std_init <= high"),
        ({"log_std_bounds": 2.0}, "pass a pair"),
        ({"alpha": -1.0}, "alpha is -1.0; it must be a number 0 or more"),
        ({"std_reg": -1.0}, "std_reg is -1.0; it must be a number 0 or more"),
        ({"body": "conv"}, "choose one of mlp, residual"),
        ({"state_dependent": "no"}, "state_dependent is 'no'; it must be true or false"),
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
def test_actor_follows_a_change_of_dtype(kind: dict[str, bool]) -> None:
    actor = actor_on(**kind).double()
    assert actor(observations(5).double())["action"].dtype == torch.float64
    assert actor.float()(observations(5))["action"].dtype == torch.float32


# In SAC


class TestLatticeSAC(plain.TestLeanSACLoss):
    """LeanSACLoss on a Lattice actor passes the check list of losses."""

    state_dependent = False

    def make_loss(self, **kwargs: Any) -> LeanSACLoss:
        options = {"state_dependent": self.state_dependent, "log_std_init": -1.0}
        return plain.make_loss(make_actor=partial(make_lattice_actor, **options), **kwargs)


class TestStateDependentLatticeSAC(TestLatticeSAC):
    state_dependent = True
