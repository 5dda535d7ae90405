"""Equations 7-10 against numbers worked out by hand, closed forms and properties."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal, kl_divergence

from tests.doubles import doubles, gradients_match, positive
from torchrl_etl import functional as F

# Eqs. 7-8


def test_gaussian_log_prob_and_kl_match_the_distributions() -> None:
    x, loc, scale = doubles(5, 3), doubles(5, 3, seed=1), positive(5, 3, seed=2)
    other = doubles(3, seed=3), positive(3, seed=4)
    q = Independent(Normal(loc, scale), 1)
    torch.testing.assert_close(F.gaussian_log_prob(x, loc, scale), q.log_prob(x))
    p = Independent(Normal(other[0].expand(5, 3), other[1].expand(5, 3)), 1)
    torch.testing.assert_close(F.gaussian_kl(loc, scale, *other), kl_divergence(q, p))


def test_categorical_kl_matches_the_distributions() -> None:
    logits = doubles(5, 4)
    expected = kl_divergence(Categorical(logits=logits), Categorical(logits=logits * 0))
    torch.testing.assert_close(F.categorical_kl(logits), expected)


def test_mixture_matches_the_distribution_and_integrates_to_one() -> None:
    loc, scale = doubles(3, 1), positive(3, 1, seed=1)
    z = torch.linspace(-30, 30, 20_001, dtype=torch.float64).unsqueeze(-1)
    log_prob = F.mixture_log_prob(z, loc, scale)
    even = Categorical(logits=torch.zeros(3).double())
    mixture = MixtureSameFamily(even, Independent(Normal(loc, scale), 1))
    torch.testing.assert_close(log_prob, mixture.log_prob(z))
    assert torch.trapezoid(log_prob.exp(), z.squeeze()).item() == pytest.approx(1.0, abs=1e-3)


# Eq. 9


def bound_inputs(batch: int = 4, components: int = 3, latent: int = 2, actuators: int = 5) -> Any:
    return {
        "action": doubles(batch, actuators),
        "decoded": doubles(batch, components, actuators, seed=1),
        "likelihood_scale": positive(actuators, seed=2),
        "logits": doubles(batch, components, seed=3),
        "loc": doubles(batch, components, latent, seed=4),
        "scale": positive(batch, components, latent, seed=5),
        "prior_loc": doubles(components, latent, seed=6),
        "prior_scale": positive(components, latent, seed=7),
    }


def test_bound_is_the_explicit_sum_over_components() -> None:
    x = bound_inputs()
    terms = F.gmvae_bound(**x)
    q = x["logits"].softmax(-1)
    for b in range(4):
        reconstruction = latent_kl = component_kl = torch.zeros((), dtype=torch.float64)
        for c in range(3):
            likelihood = Normal(x["decoded"][b, c], x["likelihood_scale"])
            posterior = Normal(x["loc"][b, c], x["scale"][b, c])
            prior = Normal(x["prior_loc"][c], x["prior_scale"][c])
            reconstruction = reconstruction + q[b, c] * likelihood.log_prob(x["action"][b]).sum()
            latent_kl = latent_kl + q[b, c] * kl_divergence(posterior, prior).sum()
            component_kl = component_kl + q[b, c] * (q[b, c] * 3).log()
        torch.testing.assert_close(terms.reconstruction[b], reconstruction)
        torch.testing.assert_close(terms.latent_kl[b], latent_kl)
        torch.testing.assert_close(terms.component_kl[b], component_kl)
        torch.testing.assert_close(terms.bound[b], reconstruction - latent_kl - component_kl)


def test_bound_with_one_component_is_the_elbo_of_a_vae() -> None:
    x = bound_inputs(components=1)
    x["prior_loc"], x["prior_scale"] = x["prior_loc"] * 0, x["prior_scale"] * 0 + 1
    terms = F.gmvae_bound(**x)
    loc, scale = x["loc"][:, 0], x["scale"][:, 0]
    # The usual ELBO of a VAE.
    variance = x["likelihood_scale"].square()
    error = (x["action"] - x["decoded"][:, 0]).square()
    log_likelihood = -0.5 * (error / variance + (2 * math.pi * variance).log()).sum(-1)
    kl = -0.5 * (1 + 2 * scale.log() - loc.square() - scale.square()).sum(-1)
    torch.testing.assert_close(terms.bound, log_likelihood - kl)
    assert (terms.component_kl == 0).all()


def test_bound_is_tight_at_the_true_posterior() -> None:
    """With Dec(z) = z everything is Gaussian: q = p(c, z | a) makes the bound log p(a)."""
    components, noise = 3, 0.6
    action = doubles(1, 1)
    prior_loc, prior_scale = doubles(components, 1, seed=1), positive(components, 1, seed=2)
    evidence_scale = (prior_scale.square() + noise**2).sqrt()
    log_joint = F.gaussian_log_prob(action.unsqueeze(-2), prior_loc, evidence_scale)
    precision = 1 / prior_scale.square() + 1 / noise**2
    scale = precision.rsqrt().unsqueeze(0)
    loc = (prior_loc / prior_scale.square() + action.unsqueeze(-2) / noise**2) / precision
    draws = 200_000
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(draws, components, 1, generator=generator, dtype=torch.float64)
    terms = F.gmvae_bound(
        action.expand(draws, 1),
        loc + scale * normal,
        torch.full((1,), noise, dtype=torch.float64),
        log_joint.expand(draws, components),
        loc.expand(draws, components, 1),
        scale.expand(draws, components, 1),
        prior_loc,
        prior_scale,
    )
    evidence = F.mixture_log_prob(action, prior_loc, evidence_scale)
    assert terms.bound.mean().item() == pytest.approx(evidence.item(), abs=5e-3)


# Eq. 10


def test_reconstruction_sums_over_actuators_and_not_over_the_batch() -> None:
    decoded = torch.tensor([[1.0, 2.0], [0.0, 0.0]])
    torch.testing.assert_close(
        F.reconstruction_loss(decoded, torch.zeros(2, 2)), torch.tensor([5.0, 0.0])
    )


# Gradients and shapes


def bound(action: Tensor, logits: Tensor, loc: Tensor, prior_loc: Tensor) -> Tensor:
    x = bound_inputs(batch=2)
    x |= {"action": action, "logits": logits, "loc": loc, "prior_loc": prior_loc}
    return F.gmvae_bound(**x).bound


GRADIENTS = {
    "mixture_log_prob": (
        lambda z, loc, raw: F.mixture_log_prob(z, loc, raw.exp()),
        [(3, 2), (4, 2), (4, 2)],
    ),
    "gmvae_bound": (bound, [(2, 5), (2, 3), (2, 3, 2), (3, 2)]),
    "reconstruction_loss": (F.reconstruction_loss, [(3, 4), (3, 4)]),
}


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradients_match_finite_differences(name: str) -> None:
    function, shapes = GRADIENTS[name]
    assert gradients_match(function, *shapes)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_any_number_of_batch_dimensions(batch: tuple[int, ...]) -> None:
    x, y = torch.randn(*batch, 4), torch.randn(*batch, 4)
    assert F.mixture_log_prob(x, torch.randn(5, 4), torch.ones(5, 4)).shape == batch
    assert F.reconstruction_loss(x, y).shape == batch
