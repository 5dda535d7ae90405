"""Gaussian-mixture VAE over muscle actions (Eqs. 7-9)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.data.tensor_specs import TensorSpec
from torchrl.modules import MLP

from torchrl_etl.checks import check_integer, check_width
from torchrl_etl.modules.clamp import Clamp
from torchrl_etl.modules.recorded_actions import as_actions, as_bounds, bounds_of

__all__ = ["GMVAE", "ActionDecoder", "Posterior"]


class Posterior(NamedTuple):
    """q(c|a) and q(z|a,c): logits [*, C]; loc and scale [*, C, d], the scale positive."""

    logits: Tensor
    loc: Tensor
    scale: Tensor


class ActionDecoder(nn.Module):
    """Dec: R^d → [low, high]^n, a multi-layer perceptron squashed into the action bounds.

    Args:
        latent_dim (int): size d of the latent.
        action_dim (int): number n of actuators.

    Keyword Args:
        low, high (float, sequence of float or Tensor): action bounds, in action units.
        hidden (sequence of int): widths of the hidden layers. Default: ``(128, 128)``.

    Raises:
        ValueError: if a size is not positive, a bound has another shape than [] or [n], or a lower
            bound is not below its upper bound.

    Examples:
        >>> import torch
        >>> decoder = ActionDecoder(2, 5, low=0.0, high=1.0)
        >>> action = decoder(torch.randn(3, 2))
        >>> action.shape, bool((action > 0).all() and (action < 1).all())
        (torch.Size([3, 5]), True)
    """

    low: Tensor
    high: Tensor

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        *,
        low: float | Sequence[float] | Tensor = -1.0,
        high: float | Sequence[float] | Tensor = 1.0,
        hidden: Sequence[int] = (128, 128),
    ) -> None:
        super().__init__()
        check_integer(1, latent_dim=latent_dim, action_dim=action_dim)
        low, high = as_bounds(low, high, action_dim)
        self.latent_dim, self.action_dim, self.hidden = latent_dim, action_dim, tuple(hidden)
        self.mlp = MLP(latent_dim, action_dim, num_cells=list(hidden), activation_class=nn.ELU)
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, latent: Tensor) -> Tensor:
        return self.denormalize(self.unit(latent))

    def unit(self, latent: Tensor) -> Tensor:
        """Actions [*, n] in units where the bounds are [-1, 1]."""
        return torch.tanh(self.mlp(latent))

    def normalize(self, action: Tensor) -> Tensor:
        """Map [low, high] to [-1, 1]."""
        check_width(self.action_dim, action=action)
        action = action.to(self.low.dtype)  # DMControl's are in double precision
        return 2 * (action - self.low) / (self.high - self.low) - 1

    def denormalize(self, unit: Tensor) -> Tensor:
        """Map [-1, 1] to [low, high]."""
        return self.low + (unit + 1) / 2 * (self.high - self.low)


class GMVAE(nn.Module):
    """Gaussian-mixture VAE: actions of n actuators ↔ d synergy coefficients.

    The generative model is c ~ Cat(1/C), z ~ N(μ_c, σ_c²), a ~ N(Dec(z), s²) with learned μ_c,
    σ_c and s (s in units where the action bounds are [-1, 1]); the inference model is q(c|a)
    q(z|a,c). One component gives the ordinary VAE.

    Equation: 7, 8 (prior); :class:`~torchrl_etl.objectives.GMVAELoss` is Eq. 9.

    Deviates: the paper writes d for the number of components and for the latent size; here they
    are two arguments with the same default.

    Args:
        action_dim (int): number n of actuators.
        latent_dim (int): number d of synergies, at most n.
        num_components (int, optional): number C of mixture components. Default: d.

    Keyword Args:
        low, high (float, sequence of float or Tensor): action bounds. Default: ±1.
        hidden (sequence of int): widths of encoder and (reversed) decoder. Default: (128, 128).

    Raises:
        ValueError: if a size is not positive or d exceeds n.

    Examples:
        >>> import torch
        >>> from torchrl_etl.modules import GMVAE
        >>> gmvae = GMVAE(action_dim=39, latent_dim=4)
        >>> posterior = gmvae.encode(torch.rand(8, 39))
        >>> posterior.logits.shape, posterior.loc.shape
        (torch.Size([8, 4]), torch.Size([8, 4, 4]))
        >>> gmvae.decode(torch.randn(8, 4)).shape
        torch.Size([8, 39])
    """

    def __init__(
        self,
        action_dim: int,
        latent_dim: int,
        num_components: int | None = None,
        *,
        low: float | Sequence[float] | Tensor = -1.0,
        high: float | Sequence[float] | Tensor = 1.0,
        hidden: Sequence[int] = (128, 128),
    ) -> None:
        super().__init__()
        num_components = latent_dim if num_components is None else num_components
        check_integer(1, num_components=num_components)
        self.decoder = ActionDecoder(
            latent_dim, action_dim, low=low, high=high, hidden=tuple(reversed(hidden))
        )
        if latent_dim > action_dim:
            raise ValueError(
                f"latent_dim is {latent_dim} but there are only {action_dim} actuators; "
                f"choose at most {action_dim} synergies."
            )
        self.latent_dim, self.action_dim = latent_dim, action_dim
        self.num_components = num_components
        # One head outputs all components' logits, means and scales: the exact expectation of
        # Eq. 9 costs one pass.
        self.encoder = MLP(
            action_dim,
            num_components * (1 + 2 * latent_dim),
            num_cells=list(hidden),
            activation_class=nn.ELU,
        )
        # Means start apart, so that components can specialize.
        self.prior_loc = nn.Parameter(
            torch.randn(num_components, latent_dim)
            if num_components > 1
            else torch.zeros(1, latent_dim)
        )
        self.prior_log_scale = nn.Parameter(torch.zeros(num_components, latent_dim))
        self.likelihood_log_scale = nn.Parameter(torch.full((action_dim,), -1.0))

    @classmethod
    def from_spec(
        cls,
        action_spec: TensorSpec,
        latent_dim: int,
        num_components: int | None = None,
        **kwargs: Any,
    ) -> GMVAE:
        """Build for one (unbatched) bounded action spec, taking n and the bounds from it.

        Raises:
            ValueError: if the spec is not one leaf of shape [n] with finite bounds.

        Examples:
            >>> from torchrl.data import Bounded
            >>> GMVAE.from_spec(Bounded(0, 1, shape=(80,)), latent_dim=4).high.max().item()
            1.0
        """
        low, high = bounds_of(action_spec)
        if low.ndim != 1:
            raise ValueError(
                f"The action spec has shape {tuple(low.shape)}; pass the bounded leaf of one "
                "environment, of shape [n], such as env.action_spec_unbatched."
            )
        return cls(
            action_spec.shape[0],
            latent_dim,
            num_components,
            low=low.tolist(),
            high=high.tolist(),
            **kwargs,
        )

    @property
    def config(self) -> dict[str, Any]:
        """JSON-able arguments: ``GMVAE(**config)`` plus a state dict rebuilds it."""
        return {
            "action_dim": self.action_dim,
            "latent_dim": self.latent_dim,
            "num_components": self.num_components,
            "low": self.low.tolist(),
            "high": self.high.tolist(),
            "hidden": list(reversed(self.decoder.hidden)),
        }

    @property
    def low(self) -> Tensor:
        return self.decoder.low

    @property
    def high(self) -> Tensor:
        return self.decoder.high

    @property
    def prior_scale(self) -> Tensor:
        """σ_c [C, d]."""
        return self.prior_log_scale.exp()

    @property
    def likelihood_scale(self) -> Tensor:
        """s [n], in units where the action bounds are [-1, 1].

        Bounded below, since the likelihood has no maximum if d latents explain the actions exactly.
        A scale at its bound can grow again as actions become more varied, which happens in stage 1.
        """
        return Clamp.apply(self.likelihood_log_scale, -4.0, math.inf).exp()

    def normalize(self, action: Tensor) -> Tensor:
        """Map actions [*, n] from [low, high] to [-1, 1]."""
        return self.decoder.normalize(action)

    def encode(self, action: Tensor) -> Posterior:
        """q(c|a) and q(z|a,c) for actions [*, n] in action units."""
        out = self.encoder(self.normalize(action))
        logits, rest = out.split(
            [self.num_components, 2 * self.num_components * self.latent_dim], -1
        )
        loc, raw_scale = rest.unflatten(-1, (self.num_components, 2 * self.latent_dim)).chunk(2, -1)
        return Posterior(logits, loc, nn.functional.softplus(raw_scale) + 1e-4)

    def decode(self, latent: Tensor) -> Tensor:
        """Mean action [*, n], inside the bounds, for latents [*, d]."""
        return self.decoder(latent)

    def infer(self, action: Tensor | np.ndarray) -> Tensor:
        """Posterior mean E[z|a] [*, d] of recorded actions, under the likeliest component.

        A mean over components could fall between two modes, where there are no actions.
        """
        if not isinstance(action, Tensor):
            action = as_actions(action, low=self.low, high=self.high)
        posterior = self.encode(action.to(self.low.device))
        best = posterior.logits.argmax(-1)[..., None, None]
        return posterior.loc.take_along_dim(best, -2).squeeze(-2)

    def reconstruct(self, action: Tensor | np.ndarray) -> Tensor:
        """Actions [*, n] decoded from their posterior means."""
        return self.decode(self.infer(action))
