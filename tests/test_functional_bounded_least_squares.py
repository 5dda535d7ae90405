"""bounded_least_squares: the minimum within the box, also where columns are nearly parallel."""

from __future__ import annotations

import torch

from tests.doubles import doubles
from torchrl_etl.functional import bounded_least_squares


def test_solution_inside_the_box_is_the_pseudo_inverse() -> None:
    weight, expected = doubles(7, 3), torch.tensor([[0.3, -0.9, 0.5]], dtype=torch.double)
    torch.testing.assert_close(bounded_least_squares(weight, expected @ weight.mT), expected)


def test_solution_at_the_bounds_meets_the_conditions_of_a_minimum() -> None:
    """The gradient is zero inside the box and points out of it at its bounds."""
    weight, target = doubles(12, 5), 3 * doubles(50, 12, seed=1)
    found = bounded_least_squares(weight, target)
    slope = (found @ weight.mT - target) @ weight
    assert (found.abs() <= 1).all() and (found.abs() == 1).any() and (found.abs() < 1).any()
    assert slope[found.abs() < 1].abs().max() < 1e-6
    assert (slope * found)[found.abs() == 1].max() < 1e-6


def test_it_beats_the_clamped_pseudo_inverse_on_nearly_parallel_columns() -> None:
    weight = torch.tensor([[1.0, 1.0], [0.0, 0.01]])
    target = torch.tensor([0.5, 0.1])
    found = bounded_least_squares(weight, target)
    clamped = (weight.pinverse() @ target).clamp(-1, 1)
    assert (weight @ found - target).norm() < 0.1 < (weight @ clamped - target).norm()
