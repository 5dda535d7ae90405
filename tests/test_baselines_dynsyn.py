"""DynSyn: an actor that moves the members of its groups together."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal
from torchrl.objectives.sac import compute_rsample_log_prob

from tests import test_objectives_sac as plain
from torchrl_etl.baselines.dynsyn import (
    GroupedTanhNormal,
    MuscleGroups,
    make_dynsyn_actor,
)
from torchrl_etl.collectors.policy_on_arrays import PolicyOnArrays
from torchrl_etl.modules import make_critic
from torchrl_etl.objectives import LeanSACLoss

GROUPS = [0, 1, 0, 2, 1, 0]  # first members 0, 1, 3; the others 2, 4, 5
LOW = torch.tensor([0.0, -1.0, -3.0, 0.1, -1.0, 0.0])
HIGH = torch.tensor([1.0, 1.0, 5.0, 0.7, 1.0, 1.0])
SPEC = Bounded(LOW, HIGH, shape=(6,))


# Distribution


def test_indices_of_groups() -> None:
    groups = MuscleGroups.of(GROUPS)
    assert groups.first.tolist() == [0, 1, 3] and groups.slot.tolist() == [0, 0, 1, 0, 2, 3]
    assert (groups.num_groups, groups.num_muscles) == (3, 6)


@pytest.mark.parametrize("wrong", [[0, 2], [1, 1], [], [[0, 1]], [0.0, 1.0], [-1, 0]])
def test_groups_not_numbered_consecutively_are_refused(wrong: list) -> None:
    with pytest.raises(ValueError, match="every index from 0 to the largest"):
        MuscleGroups.of(wrong)


def grouped(amplitude: float = 0.1, rows: int = 50, **bounds: Tensor) -> GroupedTanhNormal:
    loc, scale = torch.randn(rows, 3), torch.rand(rows, 3) + 0.1
    return GroupedTanhNormal(
        loc,
        scale,
        torch.randn(rows, 3),
        torch.full((rows, 1), amplitude),
        *MuscleGroups.of(GROUPS),
        **bounds,
    )


def weights_of(action: Tensor) -> Tensor:
    """Each member's action divided by that of its group's first member, where bounds are ±1."""
    first = MuscleGroups.of(GROUPS).first
    return action / action[..., first[torch.tensor(GROUPS)]]


def test_amplitude_zero_moves_groups_as_one() -> None:
    dist = grouped(0.0)
    for action in (dist.sample(), dist.deterministic_sample):
        for member, group in enumerate(GROUPS):
            assert torch.equal(action[:, member], action[:, GROUPS.index(group)])


def test_first_members_weigh_one_and_others_within_the_amplitude() -> None:
    dist = grouped(0.03)
    weights = weights_of(dist.sample((200,)))
    assert (weights[..., [0, 1, 3]] == 1).all()
    others = weights[..., [2, 4, 5]]
    assert (others >= 0.97 - 1e-5).all() and (others <= 1.03 + 1e-5).all()
    torch.testing.assert_close(others.amax(), torch.tensor(1.03), atol=1e-4, rtol=0)
    torch.testing.assert_close(others.amin(), torch.tensor(0.97), atol=1e-4, rtol=0)


def test_weights_by_hand() -> None:
    # Group actions tanh(1), tanh(-1), tanh(5); weights 1 + clip(0.1 tanh v, ±0.08).
    v = torch.tensor([0.5, 3.0, -0.5])
    dist = GroupedTanhNormal(
        torch.tensor([1.0, -1.0, 5.0]),
        torch.ones(3),
        v,
        torch.tensor([0.08]),
        *MuscleGroups.of(GROUPS),
    )
    y = [math.tanh(1), math.tanh(-1), math.tanh(5)]
    small = 0.1 * math.tanh(0.5)
    expected = [y[0], y[1], y[0] * (1 + small), y[2], y[1] * 1.08, y[0] * (1 - small)]
    torch.testing.assert_close(dist.deterministic_sample, torch.tensor(expected))


def test_deviations_have_the_papers_standard_deviation() -> None:
    # Weights are 1 + 0.1 tanh v with v Gaussian of mean μ and deviation e^½, so inverting them
    # gives v. Double precision resolves weights near ±10 %.
    mu = torch.tensor([0.4, -0.3, 0.0], dtype=torch.float64)
    dist = GroupedTanhNormal(
        torch.zeros_like(mu),
        torch.full_like(mu, 0.3),
        mu,
        torch.full_like(mu[:1], 0.1),
        *MuscleGroups.of(GROUPS),
    )
    v = (10 * (weights_of(dist.sample((100_000,)))[:, [2, 4, 5]] - 1)).atanh()
    torch.testing.assert_close(v.mean(0), mu, atol=0.03, rtol=0)
    torch.testing.assert_close(v.std(0), torch.full_like(mu, math.exp(0.5)), atol=0.03, rtol=0)


def test_log_prob_is_that_of_the_group_actions() -> None:
    first = [0, 1, 3]
    dist = grouped(low=LOW, high=HIGH)
    theirs = TanhNormal(
        dist.group_normal.loc, dist.group_normal.scale, low=LOW[first], high=HIGH[first]
    )
    action, log_prob = dist.rsample_and_log_prob((4,))
    torch.testing.assert_close(dist.log_prob(action), theirs.log_prob(action[..., first]))
    torch.testing.assert_close(log_prob, dist.log_prob(action), atol=2e-3, rtol=1e-3)
    others = action.clone()
    others[..., [2, 4, 5]] = 0.5
    assert torch.equal(dist.log_prob(others), dist.log_prob(action))
    assert (dist.batch_shape, dist.event_shape) == ((50,), (6,))


def test_actions_stay_within_each_muscles_bounds() -> None:
    dist = GroupedTanhNormal(
        *(10 * torch.randn(500, 3), torch.ones(500, 3), torch.randn(500, 3)),
        torch.tensor([0.1]),
        *MuscleGroups.of(GROUPS),
        low=LOW,
        high=HIGH,
    )
    action = dist.sample((10,))
    assert (action >= LOW).all() and (action <= HIGH).all()
    torch.testing.assert_close(action.amin((0, 1)), LOW, atol=1e-3, rtol=0)
    torch.testing.assert_close(action.amax((0, 1)), HIGH, atol=1e-3, rtol=0)
    # Members of a group are at nearly the same height between their bounds.
    height = (dist.deterministic_sample - LOW) / (HIGH - LOW)
    torch.testing.assert_close(height[:, 4], height[:, 1], atol=0.06, rtol=0)


def test_groups_of_one_muscle_equal_a_tanh_normal() -> None:
    loc, scale = torch.randn(2, 5, 6)
    dist = GroupedTanhNormal(
        loc,
        scale.exp(),
        torch.zeros(5, 0),
        torch.zeros(5, 1),
        *MuscleGroups.of(range(6)),
        low=LOW,
        high=HIGH,
    )
    theirs = TanhNormal(loc, scale.exp(), low=LOW, high=HIGH)
    torch.manual_seed(1)
    action = dist.rsample()
    torch.manual_seed(1)
    torch.testing.assert_close(action, theirs.rsample())
    torch.testing.assert_close(dist.log_prob(action), theirs.log_prob(action))


# Actor


def actor_on(**kwargs: Any) -> Any:
    return make_dynsyn_actor({"observation": 4}, SPEC, GROUPS, **{"hidden": (8,), **kwargs})


def observations(*rows: int) -> TensorDict:
    return TensorDict({"observation": torch.randn(*rows, 4)}, rows)


@pytest.mark.parametrize(
    ("frames", "amplitude"),
    [
        (0, 0.0),
        (1_000_000, 0.0),
        (1_200_000, 0.01),
        (2_000_000, 0.05),
        (3_000_000, 0.1),
        (9**9, 0.1),
    ],
)
def test_amplitude_schedule_by_hand(frames: int, amplitude: float) -> None:
    actor = actor_on()
    actor[0].module.advance(frames)
    written = actor(observations(2))["amplitude"]
    torch.testing.assert_close(written, torch.full((2, 1), amplitude))


def test_amplitude_schedule_is_configurable() -> None:
    actor = actor_on(slope=1e-4, start=100, ceiling=0.02)
    for frames, amplitude in ((100, 0.0), (200, 0.01), (1000, 0.02)):
        actor[0].module.advance(frames)
        torch.testing.assert_close(actor[0].module.amplitude.item(), amplitude)


def test_state_dict_carries_the_amplitude() -> None:
    one, other = actor_on(), actor_on()
    one[0].module.advance(2_000_000)
    other.load_state_dict(one.state_dict())
    assert other[0].module.amplitude.item() == pytest.approx(0.05)
    data = observations(3)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(one(data.clone())["action"], other(data.clone())["action"])


def test_loss_sees_frames_set_on_the_actor() -> None:
    actor = actor_on()
    critic = make_critic({"observation": 4, "action": 6}, hidden=(8,))
    loss = LeanSACLoss(actor, critic, target_entropy=-3.0)
    actor[0].module.advance(3_000_000)
    action, _ = loss._sample(observations(50))
    middle, half = (LOW + HIGH) / 2, (HIGH - LOW) / 2
    weights = weights_of((action - middle) / half)
    assert (weights[:, [2, 4, 5]] - 1).abs().max() > 0.05


def test_gradients_reach_scales_and_deviations() -> None:
    actor = actor_on()
    actor[0].module.advance(3_000_000)
    head = actor[0].module.layers[-1]
    action, log_prob = compute_rsample_log_prob(actor.get_dist(observations(64)))
    by_action, by_score = (
        torch.autograd.grad(out.sum(), head.weight, retain_graph=True)[0].abs().sum(1) > 0
        for out in (action, log_prob)
    )
    assert by_action.all()
    assert by_score.tolist() == [True] * 6 + [False] * 3  # k means, k scales, no deviation


def test_deviations_get_no_gradient_at_amplitude_zero() -> None:
    actor = actor_on()
    actor.get_dist(observations(64)).rsample().sum().backward()
    assert not actor[0].module.layers[-1].weight.grad[6:].any()


@pytest.mark.parametrize(
    ("groups", "options", "message"),
    [
        ([0, 1, 0], {}, "groups has 3 muscles but the action has 6"),
        ([0, 1, 0, 3, 1, 0], {}, "every index from 0 to the largest"),
        (GROUPS, {"slope": -1.0}, "slope is -1"),
        (GROUPS, {"ceiling": 0.2}, "ceiling is 0.2"),
    ],
)
def test_bad_input_is_refused_at_construction(groups: Any, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_dynsyn_actor({"observation": 4}, SPEC, groups, **options)


def test_actor_follows_a_change_of_dtype() -> None:
    actor = actor_on().double()
    assert actor(observations(5).double())["action"].dtype == torch.float64
    assert actor.float()(observations(5))["action"].dtype == torch.float32


def test_policy_on_arrays_matches_the_actor() -> None:
    actor, data = actor_on(), observations(3)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        on_arrays = PolicyOnArrays(actor)
        for frames in (0, 3_000_000):  # the traced graph reads the buffer at each call
            actor[0].module.advance(frames)
            action = on_arrays({"observation": data["observation"].numpy()})["action"]
            expected = actor(data.clone())["action"]
            torch.testing.assert_close(torch.from_numpy(action), expected)


def trained_actor(inputs: Any, spec: Bounded, **options: Any) -> Any:
    actor = make_dynsyn_actor(inputs, spec, [0, 1, 0, 1, 1], **options)
    actor[0].module.advance(2_000_000)
    return actor


class TestDynSynSAC(plain.TestLeanSACLoss):
    """LeanSACLoss on a DynSyn actor passes the check list of losses."""

    def make_loss(self, **kwargs: Any) -> LeanSACLoss:
        return plain.make_loss(make_actor=trained_actor, **kwargs)
