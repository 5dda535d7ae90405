"""DEP: the equations of its controller against numbers worked out by hand."""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.data import Bounded

from torchrl_etl.baselines.dep import DEPController, DEPExploration

MUSCLES = 3
SPEC = Bounded(0, 1, shape=(MUSCLES,))


# Angles of a joint with two antagonists, whose lengths are the angle and its negative.
ANGLES = (0.0, 0.9, 0.4, 0.6)
# From the second angle a on the range is 0.9 + 0.1 = 1, so the sensors are 2a - 1 and 0.8 - 2a. At
# the first the range is 0.1 and both lengths are at its lower end.
SENSORS = ((-1.0, -1.0), (0.8, -1.0), (-0.2, 0.0), (0.2, -0.4))
MOVES = ((0.0, 0.0), (1.8, 0.0), (-1.0, 1.0), (0.4, -0.4))


def antagonists(**settings: Any) -> tuple[DEPController, list[Tensor]]:
    settings = {"kappa": 2.0, "tau": 2, "time_distance": 1, "s4avg": 1.0, **settings}
    controller = DEPController(1, 2, **settings)
    return controller, [controller.step(torch.tensor([[a, -a]])) for a in ANGLES]


def close(value: Tensor, expected: Any) -> None:
    torch.testing.assert_close(value, torch.tensor(expected), atol=1e-5, rtol=0)


def test_sensors_and_movements_of_two_antagonists() -> None:
    controller = DEPController(1, 2, s4avg=1.0)
    for angle, sensors, move in zip(ANGLES, SENSORS, MOVES, strict=True):
        controller.step(torch.tensor([[angle, -angle]]))
        close(controller.sensed[0], sensors)
        close(controller.moves[0, 0], move)


def test_sensor_is_smoothed_from_the_second_step_on() -> None:
    controller = DEPController(1, 2, s4avg=4.0)
    x = torch.tensor(SENSORS[0])
    for angle, sensors in zip(ANGLES, SENSORS, strict=True):
        controller.step(torch.tensor([[angle, -angle]]))
        x = 0.75 * x + 0.25 * torch.tensor(sensors)
        close(controller.sensed[0], x.tolist())


def test_matrix_of_two_antagonists() -> None:
    """C = -[Δx3 Δx2ᵀ + Δx2 Δx1ᵀ]: the antagonists get opposite rows."""
    controller, _ = antagonists()
    close(controller.matrix()[0], [[2.2, -0.4], [-2.2, 0.4]])


@pytest.mark.parametrize(
    ("normalize", "expected"),
    # The rows of C have lengths 5 and 13. In the paper each row becomes a unit vector; the public
    # code divides the first column by 5 and the second by 13.
    [
        ("rows", [[3 / 5, 4 / 5], [5 / 13, -12 / 13]]),
        ("columns", [[3 / 5, 4 / 13], [5 / 5, -12 / 13]]),
    ],
)
def test_matrix_is_normalized_by_rows_or_by_columns(normalize: str, expected: Any) -> None:
    controller = DEPController(1, 2, kappa=2.0, tau=2, time_distance=2, normalize=normalize)
    # Two causes along the axes, two effects: C = -[m0 m2ᵀ + m1 m3ᵀ].
    controller.moves = -torch.tensor([[[3.0, 5.0], [4.0, -12.0], [-1.0, 0.0], [0.0, -1.0]]])
    close(controller.matrix()[0], [[3.0, 4.0], [5.0, -12.0]])
    close(controller.weights()[0], [[2 * x for x in row] for row in expected])


def test_command_signs_differ_between_row_and_column_normalization() -> None:
    commands = []
    for normalize in ("rows", "columns"):
        controller = DEPController(1, 2, kappa=2.0, tau=2, time_distance=2, normalize=normalize)
        controller.moves = -torch.tensor([[[3.0, 5.0], [4.0, -12.0], [-1.0, 0.0], [0.0, -1.0]]])
        controller.sensed = torch.tensor([[1.0, -0.9]])
        drive = controller.weights()[0] @ controller.sensed[0]
        commands.append(drive.sign().tolist())
    # First muscle: 3 - 3.6 < 0 by rows, 3/5 - 3.6/13 > 0 by columns.
    assert commands == [[-1.0, 1.0], [1.0, 1.0]]


def test_an_unknown_normalization_is_refused() -> None:
    with pytest.raises(ValueError, match="normalize is 'row'; choose one of rows, columns"):
        DEPController(1, 2, normalize="row")  # type: ignore[arg-type]


def test_commands_and_bias_of_two_antagonists() -> None:
    controller, (first, second, third, fourth) = antagonists(bias_rate=0.1)
    assert not first.any() and not second.any()  # no movement follows another yet
    # C x is along (-1, 1), then along (1, -1), so that κq is ±2/√2 without a bias.
    y = math.tanh(math.sqrt(2))
    close(third[0], [-y, y])
    # bias_rate·y = 0.089 is clipped to 0.05.
    close(controller.bias[0], [0.05, -0.05])
    close(fourth[0], [math.tanh(math.sqrt(2) + 0.05), -math.tanh(math.sqrt(2) + 0.05)])


def test_bias_opposes_the_command_and_decays() -> None:
    controller, (*_, third, fourth) = antagonists(bias_rate=0.01)
    close(controller.bias, (-0.01 * third).tolist())
    before = controller.bias = torch.tensor([[0.5, -0.25]])
    controller.step(torch.tensor([[0.7, -0.7]]))
    close(controller.bias, (before - 0.01 * fourth - 0.001 * before).tolist())


def test_rows_are_scaled_to_length_kappa() -> None:
    """Rows (3, 4), (0, -2) become κ(0.6, 0.8), κ(0, -1): q is along (1.4, -1) for x = (1, 1)."""
    controller = DEPController(1, 2, kappa=0.5, tau=1, time_distance=1, bias_rate=0.0)
    controller.matrix = lambda: torch.tensor([[[3.0, 4.0], [0.0, -2.0]]])
    controller._sense = lambda lengths: setattr(controller, "sensed", lengths)
    norm = math.hypot(1.4, 1)
    expected = [math.tanh(0.5 * 1.4 / norm), math.tanh(-0.5 / norm)]
    close(controller.step(torch.ones(1, 2))[0], expected)


@pytest.mark.parametrize(("tau", "distance", "steps"), [(4, 2, 12), (3, 5, 20), (40, 5, 12)])
def test_matrix_equals_the_papers_sum(tau: int, distance: int, steps: int) -> None:
    rows, n = 2, 3
    controller = DEPController(rows, n, tau=tau, time_distance=distance, dtype=torch.float64)
    sensed = []
    for _ in range(steps):
        controller.step(torch.rand(rows, n, dtype=torch.float64))
        sensed.append(controller.sensed)
    moves = [torch.zeros_like(sensed[0])] + [b - a for a, b in pairwise(sensed)]
    expected = torch.zeros(rows, n, n, dtype=torch.float64)
    for row in range(rows):
        for k in range(tau):
            late, early = steps - 1 - k, steps - 1 - k - distance
            if early >= 0:
                for i in range(n):
                    for j in range(n):
                        expected[row, i, j] -= moves[late][row, i] * moves[early][row, j]
    torch.testing.assert_close(controller.matrix(), expected)


def test_constant_lengths_give_zero_commands() -> None:
    controller = DEPController(2, 4)
    for _ in range(60):
        command = controller.step(torch.full((2, 4), 0.3))
    assert not command.any()


def test_commands_are_bounded_and_finite_for_any_lengths() -> None:
    for size in (1e-8, 1.0, 1e4):
        controller = DEPController(3, 5)
        for _ in range(60):
            command = controller.step(size * torch.randn(3, 5))
        assert command.isfinite().all() and command.abs().max() <= 1


def test_reset_records_no_movement_and_keeps_the_other_memory() -> None:
    controller = DEPController(3, 4)
    for _ in range(20):
        controller.step(torch.rand(3, 4))
    before = copy.deepcopy(controller)
    controller.reset(torch.tensor([False, True, False]))
    controller.step(torch.full((3, 4), 0.5))
    assert not controller.moves[1, 0].any() and controller.moves[[0, 2], 0].all()
    assert torch.equal(controller.moves[:, 1:], before.moves[:, :-1])
    assert torch.equal(controller.shortest, before.shortest)
    # Without smoothing across the reset.
    sensor = 2 * ((0.5 - before.shortest[1]) / (before.longest - before.shortest + 0.1)[1] - 0.5)
    torch.testing.assert_close(controller.sensed[1], sensor)


def test_rows_of_the_controller_are_independent() -> None:
    lengths, others = torch.rand(2, 30, 3, 4)
    others[:, 1] = lengths[:, 1]
    one, other = DEPController(3, 4), DEPController(3, 4)
    for a, b in zip(lengths, others, strict=True):
        first, second = one.step(a), other.step(b)
        assert torch.equal(first[1], second[1])
    assert not torch.isclose(first[0], second[0]).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kappa": 0}, "kappa is 0; it must be a number above 0"),
        ({"tau": 0}, "tau is 0; it must be a whole number, 1 or more"),
        ({"time_distance": 0}, "time_distance is 0; it must be a whole number, 1 or more"),
        ({"bias_rate": -1}, "bias_rate is -1; it must be a number 0 or more"),
        ({"s4avg": 0.5}, r"s4avg is 0.5; it must be a number in \[1, inf\)"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DEPExploration(SPEC, **settings)
