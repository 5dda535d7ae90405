"""METRALoss: the checks of a loss, values by hand, and its Lagrange multiplier."""

# ruff: noqa: RUF012  (class attributes that configure a check list are constants)

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.lookup_tables import steps, table
from tests.loss_checks import LossChecks
from torchrl_etl.modules import StateEncoder
from torchrl_etl.objectives.metra import METRALoss

OBSERVATION_DIM, EMBEDDING_DIM = 5, 3


class TestMETRALoss(LossChecks):
    default_keys = {"direction": "direction"}
    recorded = {"direction"}
    trained = {"loss_representation": {"encoder_params"}, "loss_lambda": {"log_lambda"}}

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> METRALoss:
        keys = {"in_keys": [("agent", "observation")]} if nested else {}
        encoder = StateEncoder(OBSERVATION_DIM, EMBEDDING_DIM, hidden=(16, 16), **keys)
        loss = METRALoss(encoder, **kwargs)
        if nested:
            loss.set_keys(direction=("agent", "direction"))
        return loss

    def make_data(self, batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
        observation, following = torch.randn(2, *batch, OBSERVATION_DIM)
        direction = nn.functional.normalize(torch.randn(*batch, EMBEDDING_DIM), dim=-1)
        root = {"observation": observation, "direction": direction}
        after = {"observation": following}
        if nested:
            root, after = {"agent": root}, {"agent": after}
        return TensorDict(root | {"next": TensorDict(after, batch)}, batch)


class TestMeanNorm(TestMETRALoss):
    def make_loss(self, **kwargs: Any) -> METRALoss:
        return super().make_loss(norm="mean", **kwargs)


# Values on a lookup table of embeddings


def transitions(
    states: list[int], following: list[int], directions: list[list[float]], num: int
) -> TensorDict:
    return steps(states, following, num, direction=torch.tensor(directions))


# Steps (3, 4), of length 5, and (0.3, 0.4), of length 0.5.
ROWS = [0.0, 0.0], [3.0, 4.0], [3.3, 4.4]
LONG, SHORT = ([0], [1]), ([1], [2])
DIRECTION = [[0.6, 0.8]]


@pytest.mark.parametrize(
    ("norm", "step", "bonus", "slack"),
    [
        ("sum", LONG, 5.0, 1 - 25),
        ("mean", LONG, 5.0, 1 - 12.5),
        ("sum", SHORT, 0.5, 0.001),
        ("mean", SHORT, 0.5, 0.001),
    ],
)
def test_losses_by_hand(norm: str, step: tuple, bonus: float, slack: float) -> None:
    loss = METRALoss(table(*ROWS), norm=norm, lambda_init=30.0, epsilon=0.001)
    out = loss(transitions(*step, DIRECTION, 3))
    assert out["loss_representation"].item() == pytest.approx(-(bonus + 30 * slack), rel=1e-4)
    assert out["loss_lambda"].item() == pytest.approx(math.log(30) * slack, rel=1e-4)
    assert out["mean_bonus"].item() == pytest.approx(bonus, rel=1e-4)
    assert out["mean_step"].item() == pytest.approx(bonus, rel=1e-4)
    assert out["multiplier"].item() == pytest.approx(30.0)


def test_epsilon_caps_each_transition_before_averaging() -> None:
    loss = METRALoss(table(*ROWS), epsilon=0.5, lambda_init=2.0, reduction="none")
    out = loss(transitions([0, 1], [1, 2], DIRECTION * 2, 3))
    expected = torch.tensor([-(5 - 2 * 24.0), -(0.5 + 2 * 0.5)])
    torch.testing.assert_close(out["loss_representation"], expected)


def test_steps_against_the_direction_earn_a_negative_bonus() -> None:
    out = METRALoss(table(*ROWS))(transitions([1], [0], DIRECTION, 3))
    assert out["mean_bonus"].item() == pytest.approx(-5.0)


@pytest.mark.parametrize(("step", "rises"), [(LONG, True), (SHORT, False)])
def test_lambda_rises_for_long_steps_and_falls_for_short_ones(step: tuple, rises: bool) -> None:
    loss = METRALoss(table(*ROWS))
    optimizer = torch.optim.SGD([loss.log_lambda], lr=1.0)
    data = transitions(*step, DIRECTION, 3)
    before = loss.log_lambda.item()
    loss(data)["loss_lambda"].backward()
    optimizer.step()
    # A long step raises it by 25 - 1; a short one lowers it by epsilon at most.
    assert loss.log_lambda.item() - before == pytest.approx(24.0 if rises else -0.001, rel=0.02)
    assert loss(data)["multiplier"] > 0


def test_slack_beyond_epsilon_gives_no_gradient() -> None:
    loss = METRALoss(table(*ROWS), epsilon=0.5)
    loss(transitions(*SHORT, DIRECTION, 3))["loss_representation"].backward()
    gradient = next(loss.encoder_params.parameters()).grad
    # The gradient of the bonus alone: row 2 minus row 1, along the direction.
    torch.testing.assert_close(gradient[2], -torch.tensor(DIRECTION[0]))
    torch.testing.assert_close(gradient[1], torch.tensor(DIRECTION[0]))


@pytest.mark.parametrize(
    ("norm", "lambda_init", "length"),
    [("sum", 30.0, 1.0), ("sum", 0.1, 1.0), ("mean", 30.0, 2**0.5)],
)
def test_steps_on_a_chain_converge_to_the_bound(
    norm: str, lambda_init: float, length: float
) -> None:
    states = 5
    rows = (0.1 * torch.randn(states, 2)).tolist()
    loss = METRALoss(table(*rows), norm=norm, lambda_init=lambda_init)
    right, left = list(range(states - 1)), list(range(1, states))
    directions = [[1.0, 0.0]] * len(right) + [[-1.0, 0.0]] * len(left)
    data = transitions(right + left, left + right, directions, states)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    for _ in range(800):
        out = loss(data)
        optimizer.zero_grad()
        (out["loss_representation"] + out["loss_lambda"]).backward()
        optimizer.step()
    out = loss(data)
    assert out["mean_step"].item() == pytest.approx(length, rel=0.05)
    assert out["mean_bonus"].item() == pytest.approx(length, rel=0.05)
    # The ends of the chain are as far apart as the steps between them add up to.
    rows = next(loss.encoder_params.parameters())
    apart = (rows[-1] - rows[0]).norm().item()
    assert apart == pytest.approx((states - 1) * length, rel=0.05)


def test_lambda_is_saved_and_reset_to_its_initial_value() -> None:
    loss = METRALoss(table(*ROWS), lambda_init=7.0)
    other = METRALoss(table(*ROWS))
    other.load_state_dict(loss.state_dict())
    data = transitions(*LONG, DIRECTION, 3)
    assert other(data)["multiplier"].item() == pytest.approx(7.0)
    loss.log_lambda.data.fill_(0.0)
    loss.reset_parameters_recursive()
    assert loss(data)["multiplier"].item() == pytest.approx(7.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"norm": "max"}, "norm is 'max'; choose one of sum, mean"),
        ({"epsilon": 0.0}, "epsilon is 0.0; it must be a number above 0"),
        ({"lambda_init": -1.0}, "lambda_init is -1.0; it must be a number above 0"),
    ],
)
def test_wrong_options_are_refused_at_construction(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        METRALoss(table(*ROWS), **options)


def test_plain_networks_are_refused() -> None:
    with pytest.raises(TypeError, match="encoder is a Linear; pass a TensorDictModuleBase"):
        METRALoss(nn.Linear(2, 2))


def test_direction_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="has 2 dimensions but the direction has 1"):
        METRALoss(table(*ROWS))(transitions(*LONG, [[1.0]], 3))
