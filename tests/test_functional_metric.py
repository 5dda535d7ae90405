"""Equations 1-6 against numbers worked out by hand, closed forms and properties."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Normal

from tests.doubles import doubles, gradients_match, positive
from torchrl_etl import functional as F

# Eq. 1


def test_bonus_by_hand() -> None:
    embedding = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
    following = torch.tensor([[2.0, 5.0], [0.0, 1.0]])
    direction = torch.tensor([[1.0, 0.0], [0.6, 0.8]])
    bonus = F.direction_bonus(embedding, following, direction)
    torch.testing.assert_close(bonus, torch.tensor([[2.0], [-0.6]]))


def test_bonus_telescopes_along_a_trajectory() -> None:
    path, direction = doubles(20, 4), doubles(4, seed=1)
    total = F.direction_bonus(path[:-1], path[1:], direction).sum()
    torch.testing.assert_close(total, (path[-1] - path[0]) @ direction)


def test_bonus_is_largest_along_the_displacement() -> None:
    x, y = doubles(4), doubles(4, seed=1)
    directions = torch.nn.functional.normalize(doubles(500, 4, seed=2), dim=-1)
    best = F.direction_bonus(x, y, torch.nn.functional.normalize(y - x, dim=-1))
    assert (F.direction_bonus(x, y, directions) <= best).all()
    torch.testing.assert_close(best.squeeze(), (y - x).norm())


# Eq. 2: distances and divergences


def test_l2_by_hand_and_its_gradient_at_zero() -> None:
    x = torch.zeros(3, requires_grad=True)
    distance = F.l2_distance(x, torch.zeros(3))
    distance.backward()
    assert distance.item() < 1e-5
    assert (x.grad == 0).all()
    assert F.l2_distance(torch.zeros(2), torch.tensor([3.0, 4.0])).item() == pytest.approx(5.0)


def test_l2_is_a_metric() -> None:
    points = doubles(30, 4)
    distance = F.l2_distance(points.unsqueeze(1), points)
    torch.testing.assert_close(distance, distance.T)
    detour = (distance.unsqueeze(2) + distance.unsqueeze(0)).amin(1)
    assert (distance <= detour + 1e-6).all()


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        ([2.0, 0.0], [0.0, 4.0], 10 + 0.1 * math.pi / 2),
        ([3.0, 0.0], [3.0, 0.0], 9.0),
        ([1.0, 0.0], [-1.0, 0.0], 1 + 0.1 * math.pi),
        ([1.0, 1.0], [2.0, 0.0], 3 + 0.1 * math.pi / 4),
        ([0.0, 0.0], [2.0, 0.0], 2.0),
        ([0.0, 0.0], [0.0, 0.0], 0.0),
    ],
)
def test_mico_by_hand(x: list[float], y: list[float], expected: float) -> None:
    pair = torch.tensor(x, requires_grad=True), torch.tensor(y, requires_grad=True)
    distance = F.mico_distance(*pair)
    assert distance.item() == pytest.approx(expected, rel=1e-5)
    distance.backward()
    assert all(point.grad.isfinite().all() for point in pair)


def test_mico_gradient_is_finite_at_the_origin() -> None:
    x = torch.zeros(3, requires_grad=True)
    F.mico_distance(x, torch.ones(3)).backward()
    assert x.grad.isfinite().all()


def test_w2_by_hand_and_from_quantiles_in_one_dimension() -> None:
    value = F.gaussian_w2(
        torch.tensor([1.0, 0.0]),
        torch.tensor([2.0, 1.0]),
        torch.tensor([1.0, 2.0]),
        torch.tensor([1.0, 3.0]),
    )
    assert value.item() == pytest.approx(3.0)  # sqrt(0 + 4 + 1 + 4)
    # In one dimension the optimal plan pairs quantiles.
    quantiles = torch.linspace(1e-5, 1 - 1e-5, 200_001, dtype=torch.float64)
    a, b = Normal(0.5, 2.0).icdf(quantiles), Normal(-1.0, 0.7).icdf(quantiles)
    numeric = (a - b).square().mean().sqrt()
    exact = F.gaussian_w2(*(torch.tensor([v]) for v in (0.5, 2.0, -1.0, 0.7)))
    assert exact.item() == pytest.approx(numeric.item(), rel=1e-2)


def test_w2_without_spread_is_the_l2_distance() -> None:
    x, y, zero = doubles(5, 3), doubles(5, 3, seed=1), torch.zeros(5, 3, dtype=torch.float64)
    torch.testing.assert_close(F.gaussian_w2(x, zero, y, zero), F.l2_distance(x, y))


def test_metric_target_is_symmetric_and_contracts() -> None:
    reward_i, reward_j = doubles(10), doubles(10, seed=1)
    one, two = positive(10, seed=2), positive(10, seed=3)
    target = F.metric_target(reward_i, reward_j, one, 0.9)
    torch.testing.assert_close(target, F.metric_target(reward_j, reward_i, one, 0.9))
    gap = (target - F.metric_target(reward_i, reward_j, two, 0.9)).abs()
    torch.testing.assert_close(gap, 0.9 * (one - two).abs())


# Eqs. 3-6


def test_metric_loss_by_hand() -> None:
    torch.testing.assert_close(
        F.metric_loss(torch.tensor([1.0, 4.0]), torch.tensor([3.0, 4.0])), torch.tensor([2.0, 0.0])
    )


def test_expected_distance_sums_the_geometric_series() -> None:
    series = sum(0.9**t * 2.0 for t in range(1000))
    assert F.expected_distance(2.0, 0.9) == pytest.approx(series)


@pytest.mark.parametrize("gamma", [1.0, 1.5, -0.1])
def test_expected_distance_refuses_a_divergent_series(gamma: float) -> None:
    with pytest.raises(ValueError, match=r"gamma is .*; it must be a number in \[0, 1\)"):
        F.expected_distance(1.0, gamma)


def test_discriminability_counts_only_pairs_with_similar_rewards() -> None:
    reward_i, reward_j = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.05, 0.1, 3.0])
    x, y = torch.zeros(3, 2), torch.tensor([[0.3, 0.4]]).expand(3, 2)
    hinge = F.discriminability(reward_i, reward_j, x, y, epsilon=0.1, margin=2.0)
    literal = F.discriminability(reward_i, reward_j, x, y, epsilon=0.1, form="literal")
    torch.testing.assert_close(hinge, torch.tensor([2.25, 0.0, 0.0]))
    torch.testing.assert_close(literal, torch.tensor([0.25, 0.0, 0.0]))


def test_hinge_pushes_apart_what_literal_pulls_together() -> None:
    same = torch.zeros(()), torch.zeros(())
    for form, sign in (("hinge", 1.0), ("literal", -1.0)):
        x = torch.tensor([0.3], requires_grad=True)
        F.discriminability(*same, x, torch.zeros(1), 0.1, 1.0, form).backward()
        assert -x.grad.item() * sign > 0, form  # the direction of a descent step


def test_hinge_is_zero_beyond_its_margin() -> None:
    x = torch.tensor([1.5], requires_grad=True)
    penalty = F.discriminability(torch.zeros(()), torch.zeros(()), x, torch.zeros(1), 0.1, 1.0)
    penalty.backward()
    assert penalty.item() == 0.0 and x.grad.item() == 0.0


def minimum_of_eq6(form: str, weight: float, target: float) -> float:
    """Distance that minimizes Eq. 6 for equal rewards and a stopped target."""
    distance = torch.linspace(0.0, 3.0, 300_001, dtype=torch.float64)
    zero = torch.zeros_like(distance)
    embedding = distance.unsqueeze(-1), zero.unsqueeze(-1)
    regularizer = F.discriminability(zero, zero, *embedding, 0.1, 1.0, form)  # type: ignore[arg-type]
    whole = F.metric_loss(distance, zero + target) + weight * regularizer
    return distance[whole.argmin()].item()


@pytest.mark.parametrize("weight", [0.1, 0.5, 2.0])
def test_literal_minimum_contracts_and_hinge_minimum_expands(weight: float) -> None:
    gamma, following = 0.9, 0.8
    literal = minimum_of_eq6("literal", weight, gamma * following)
    hinge = minimum_of_eq6("hinge", weight, gamma * following)
    assert literal == pytest.approx(gamma * following / (1 + 2 * weight), abs=1e-4)
    assert hinge == pytest.approx((gamma * following + 2 * weight) / (1 + 2 * weight), abs=1e-4)
    assert literal < gamma * following < hinge


def test_unknown_form_is_refused() -> None:
    with pytest.raises(ValueError, match="form is 'paper'; choose one of hinge, literal"):
        one = torch.ones(1)
        F.discriminability(one, one, one, one, 0.1, form="paper")  # type: ignore[arg-type]


def test_effective_rank_counts_dimensions_in_use() -> None:
    axis = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    assert F.effective_rank(axis).item() == pytest.approx(1.0, abs=1e-4)
    cube = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    assert F.effective_rank(cube).item() == pytest.approx(3.0, abs=1e-4)
    assert F.effective_rank(cube.reshape(2, 4, 3) + 5.0).item() == pytest.approx(3.0, abs=1e-4)
    assert F.effective_rank(torch.full((6, 3), 2.0)).item() == 0.0


# Gradients and shapes


GRADIENTS = {
    "direction_bonus": (F.direction_bonus, [(3, 4), (3, 4), (3, 4)]),
    "l2_distance": (F.l2_distance, [(3, 4), (3, 4)]),
    "mico_distance": (F.mico_distance, [(3, 4), (3, 4)]),
    "gaussian_w2": (F.gaussian_w2, [(3, 4)] * 4),
    "metric_loss": (F.metric_loss, [(3,), (3,)]),
    "hinge": (lambda x, y: F.discriminability(x[:, 0], x[:, 0], x, y, 1.0, 5.0), [(3, 4)] * 2),
}


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradients_match_finite_differences(name: str) -> None:
    function, shapes = GRADIENTS[name]
    assert gradients_match(function, *shapes)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_any_number_of_batch_dimensions(batch: tuple[int, ...]) -> None:
    x, y, r = torch.randn(*batch, 4), torch.randn(*batch, 4), torch.randn(batch)
    assert F.direction_bonus(x, y, x).shape == (*batch, 1)
    assert F.l2_distance(x, y).shape == F.mico_distance(x, y).shape == batch
    assert F.gaussian_w2(x, y.exp(), y, x.exp()).shape == batch
    assert F.discriminability(r, r, x, y, 0.1).shape == batch
