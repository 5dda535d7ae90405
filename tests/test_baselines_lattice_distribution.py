"""Lattice: its covariance and its squashed density."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from tests.test_baselines_lattice import HIGH, LOW
from torchrl_etl.baselines.lattice import LatticeNormal, lattice_scale_tril


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
def test_float32_cholesky_succeeds_for_collinear_actuators(width: float) -> None:
    weight = width * torch.ones(80, 1) @ torch.rand(1, 256) + 1e-4 * torch.randn(80, 256)
    weight.requires_grad_()
    lower = lattice_scale_tril(weight, torch.rand(16, 256), torch.full((16, 80), 1e-6))
    lower.square().sum().backward()
    assert lower.isfinite().all() and weight.grad.isfinite().all()
    exact = weight.double().square() @ torch.ones(256).double()
    scale = lower.detach().square().sum(-1) / exact
    assert (scale < 1).all() and (scale > 0.2).all()  # mean variance of a feature: a half


def test_scale_tril_passes_gradcheck() -> None:
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


def test_rsample_and_log_prob_agrees_with_log_prob() -> None:
    loc, lower = gaussian()
    normal = LatticeNormal(loc, lower, low=LOW, high=HIGH)
    action, log_prob = normal.rsample_and_log_prob((100,))
    torch.testing.assert_close(log_prob, normal.log_prob(action), rtol=1e-5, atol=1e-5)
    assert (action >= LOW).all() and (action <= HIGH).all()


def test_gradient_of_rsample_and_log_prob_equals_the_explicit_density() -> None:
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


def test_log_prob_is_finite_at_and_near_the_bounds() -> None:
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
