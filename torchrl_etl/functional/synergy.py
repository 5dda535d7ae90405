"""Synergy representation (Eqs. 7-10): the mixture prior, the bound, the reconstruction."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

__all__ = [
    "GMVAEBound",
    "categorical_kl",
    "gaussian_kl",
    "gaussian_log_prob",
    "gmvae_bound",
    "mixture_log_prob",
    "reconstruction_loss",
]


def gaussian_log_prob(value: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    r"""Log-density of a diagonal Gaussian, summed over the last dimension.

    Args:
        value (Tensor): points, ``[*, n]``.
        loc (Tensor): means, ``[*, n]``.
        scale (Tensor): standard deviations, broadcastable to ``[*, n]``.

    Returns:
        Tensor: log-densities, ``[*]``.

    Equation: 7 (:math:`p(z|c)`) and 9 (:math:`p(a|z)`)

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import gaussian_log_prob
        >>> gaussian_log_prob(torch.zeros(2), torch.zeros(2), torch.ones(2))  # -log(2 pi)
        tensor(-1.8379)
    """
    standardized = (value - loc) / scale
    return -(0.5 * standardized.square() + scale.log() + 0.5 * math.log(2 * math.pi)).sum(-1)


def gaussian_kl(loc_q: Tensor, scale_q: Tensor, loc_p: Tensor, scale_p: Tensor) -> Tensor:
    r"""Closed-form :math:`\mathrm{KL}(q \| p)` of diagonal Gaussians, summed over dimensions.

    Args:
        loc_q, scale_q (Tensor): means and standard deviations of ``q``, ``[*, d]``.
        loc_p, scale_p (Tensor): means and deviations of ``p``, broadcastable to ``[*, d]``.

    Returns:
        Tensor: divergences in nats, ``[*]``.

    Equation: 9 (:math:`\mathrm{KL}(q(z|a,c) \| p(z|c))`)

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import gaussian_kl
        >>> one = torch.ones(1)
        >>> gaussian_kl(2 * one, one, 0 * one, one)
        tensor(2.)
    """
    ratio = scale_q / scale_p
    shift = (loc_q - loc_p) / scale_p
    return (0.5 * (ratio.square() + shift.square() - 1) - ratio.log()).sum(-1)


def categorical_kl(logits: Tensor) -> Tensor:
    r""":math:`\mathrm{KL}(q(c) \| p(c))` of categorical distributions from the uniform one.

    Args:
        logits (Tensor): logits of ``q``, ``[*, C]``; ``p`` is the paper's fixed uniform prior.

    Returns:
        Tensor: divergences in nats, ``[*]``; zero for a single component.

    Equation: 9 (:math:`\mathrm{KL}(q(c|a) \| p(c))`)

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import categorical_kl
        >>> categorical_kl(torch.tensor([100.0, 0.0]))  # log 2
        tensor(0.6931)
    """
    log_q = logits.log_softmax(-1)
    return (log_q.exp() * (log_q + math.log(logits.shape[-1]))).sum(-1)


def mixture_log_prob(z: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    r"""Log-density of the Gaussian-mixture prior over synergy coefficients.

    .. math:: p(z) = \tfrac1C \sum_c \mathcal N(z; \mu_c, \Sigma_c)

    Args:
        z (Tensor): synergy coefficients, ``[*, d]``.
        loc, scale (Tensor): means and standard deviations of the components, ``[C, d]``.

    Returns:
        Tensor: log-densities, ``[*]``.

    Equation: 7 (the summands) and 8

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import mixture_log_prob
        >>> loc, scale = torch.tensor([[-1.0], [1.0]]), torch.ones(2, 1)
        >>> mixture_log_prob(torch.zeros(1), loc, scale)  # -0.5 - log(2 pi) / 2
        tensor(-1.4189)
    """
    per_component = gaussian_log_prob(z.unsqueeze(-2), loc, scale)
    return (per_component - math.log(len(loc))).logsumexp(-1)


class GMVAEBound(NamedTuple):
    """The lower bound of Eq. 9 and its three terms, each ``[*]`` and in nats.

    Attributes:
        bound: ``reconstruction - latent_kl - component_kl``, to be maximized.
        reconstruction: expected log-likelihood of the action.
        latent_kl: expected divergence of ``q(z|a,c)`` from ``p(z|c)``.
        component_kl: divergence of ``q(c|a)`` from ``p(c)``.
    """

    bound: Tensor
    reconstruction: Tensor
    latent_kl: Tensor
    component_kl: Tensor


def gmvae_bound(
    action: Tensor,
    decoded: Tensor,
    likelihood_scale: Tensor,
    logits: Tensor,
    loc: Tensor,
    scale: Tensor,
    prior_loc: Tensor,
    prior_scale: Tensor,
) -> GMVAEBound:
    r"""Variational lower bound of the Gaussian-mixture VAE, per sample.

    .. math::
        \mathcal L(a) = \sum_c q(c|a) \big[ \log p(a|z_c)
            - \mathrm{KL}(q(z|a,c) \| p(z|c)) \big] - \mathrm{KL}(q(c|a) \| p(c)),
        \qquad z_c \sim q(z|a,c)

    With one component the last term is zero and the rest is the bound of an ordinary VAE.

    Args:
        action (Tensor): actions, ``[*, n]``.
        decoded (Tensor): means of :math:`p(a|z_c)`, decoded from one reparameterized sample
            :math:`z_c` of every component, ``[*, C, n]``.
        likelihood_scale (Tensor): standard deviation of :math:`p(a|z)`, broadcastable to
            ``[*, C, n]``.
        logits (Tensor): logits of :math:`q(c|a)`, ``[*, C]``.
        loc, scale (Tensor): means and standard deviations of :math:`q(z|a,c)`, ``[*, C, d]``.
        prior_loc (Tensor): :math:`\mu_c`, ``[C, d]``.
        prior_scale (Tensor): square roots of the diagonal of :math:`\Sigma_c`, ``[C, d]``.

    Returns:
        GMVAEBound: the bound and its three terms, each ``[*]``.

    Equation: 9

    Deviates: the expectation over ``c`` is summed exactly (the paper does not say how it is
        taken); with a handful of components that is cheap and has no sampling noise.

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import gmvae_bound
        >>> action, decoded = torch.zeros(1), torch.tensor([[0.0], [1.0]])
        >>> terms = gmvae_bound(
        ...     action, decoded, torch.ones(1), torch.zeros(2),
        ...     torch.zeros(2, 1), torch.ones(2, 1), torch.tensor([[0.0], [2.0]]), torch.ones(2, 1),
        ... )
        >>> terms.latent_kl  # (0 + 2) / 2
        tensor(1.)
        >>> terms.component_kl
        tensor(0.)
        >>> terms.bound  # -(0 + 1/2) / 2 - log(2 pi) / 2 - 1
        tensor(-2.1689)
    """
    probability = logits.softmax(-1)
    log_likelihood = gaussian_log_prob(action.unsqueeze(-2), decoded, likelihood_scale)
    reconstruction = (probability * log_likelihood).sum(-1)
    latent_kl = (probability * gaussian_kl(loc, scale, prior_loc, prior_scale)).sum(-1)
    component_kl = categorical_kl(logits)
    bound = reconstruction - latent_kl - component_kl
    return GMVAEBound(bound, reconstruction, latent_kl, component_kl)


def reconstruction_loss(decoded: Tensor, action: Tensor) -> Tensor:
    r"""Squared error between a decoded synergy and its recorded action.

    .. math:: |\mathrm{Dec}(z) - a|^2

    Args:
        decoded (Tensor): :math:`\mathrm{Dec}(z)`, ``[*, n]``.
        action (Tensor): recorded actions, ``[*, n]``.

    Returns:
        Tensor: squared errors summed over actuators, ``[*]``.

    Equation: 10

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import reconstruction_loss
        >>> reconstruction_loss(torch.tensor([1.0, 2.0]), torch.tensor([0.0, 0.0]))
        tensor(5.)
    """
    return (decoded - action).square().sum(-1)
