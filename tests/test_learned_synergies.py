"""Principal directions of a policy's actions, as a decoder."""

from __future__ import annotations

import pytest
import torch

from benchmarks.learned_synergies import principal_directions
from torchrl_etl.envs import make_env


@pytest.fixture
def spec():
    return make_env("overactuated")  # 16 muscles within [-1, 1]


def test_two_directions_before_the_bounds_are_found_with_their_ranges(spec):
    torch.manual_seed(0)
    center, basis = torch.randn(16) / 4, torch.linalg.qr(torch.randn(16, 2)).Q.mT
    coefficients = (2 * torch.rand(20_000, 2) - 1) * torch.tensor([1.2, 0.4])
    actions = (center + coefficients @ basis).tanh()
    decoder = principal_directions(actions, 2, spec)
    (layer,) = (m for m in decoder.modules() if isinstance(m, torch.nn.Linear))
    # Rows of 98 % of a uniform range: the larger first, each with either sign.
    sizes = layer.weight.norm(dim=0)
    torch.testing.assert_close(sizes, 0.98 * torch.tensor([1.2, 0.4]), rtol=0.02, atol=0)
    overlap = (layer.weight.mT / sizes[:, None]) @ basis.mT
    torch.testing.assert_close(overlap.abs(), torch.eye(2), rtol=0, atol=0.02)
    torch.testing.assert_close(layer.bias, center, rtol=0, atol=0.02)


def test_muscles_at_their_bounds_leave_the_decoder_finite(spec):
    actions = torch.ones(100, 16)
    actions[::2] = -1.0
    decoder = principal_directions(actions, 1, spec)
    ends = decoder.module(torch.tensor([[-1.0], [1.0]]))
    assert ends.isfinite().all()
    assert torch.allclose(ends.abs(), torch.tensor(0.99), atol=1e-4)
