"""The decoder of stage 2, from synergy coefficients to muscle actions."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_etl.checks import check_width
from torchrl_etl.functional import bounded_least_squares, tanh_sum, tanh_sum_log_slope
from torchrl_etl.modules.gmvae import GMVAE, ActionDecoder
from torchrl_etl.modules.recorded_actions import as_actions
from torchrl_etl.modules.synergy_map import SynergyMap

__all__ = ["SynergyDecoder", "percentile_box"]

# Bound on the synergies alone: in single precision tanh reaches 1, where a residual has no effect.
INSIDE = 1.0 - 1e-6
# Clamp of recorded actions before they are inverted, in units where the bounds are ±1.
NEAREST = 0.99
_MOST_ROWS = 100_000


def percentile_box(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Center and half width [d] of the 1st to 99th percentile of coefficients [N, d].

    Examples:
        >>> percentile_box(torch.linspace(0, 4, 101)[:, None])
        (tensor([2.]), tensor([1.9600]))
    """
    # torch.quantile accepts at most 16 million numbers.
    rows = coefficients[:: 1 + len(coefficients) // _MOST_ROWS]
    low, high = rows.quantile(rows.new_tensor([0.01, 0.99]), dim=0)
    return (high + low) / 2, (high - low) / 2


class _ScaledDecoder(nn.Module):
    """u ∈ [-1, 1]^d → Dec(center + scale·u), plus an optional bounded residual."""

    center: Tensor
    scale: Tensor

    def __init__(self, decoder: ActionDecoder, residual: float) -> None:
        super().__init__()
        self.decoder = decoder
        self.residual = residual
        self.register_buffer("center", torch.zeros(decoder.latent_dim))
        self.register_buffer("scale", torch.ones(decoder.latent_dim))

    def forward(self, synergy: Tensor) -> Tensor:
        direct = self.decoder.action_dim if self.residual else 0
        check_width(self.decoder.latent_dim + direct, synergy=synergy)
        synergy = synergy.to(self.decoder.mlp[0].weight.dtype)
        if not self.residual:
            return self.decoder(self.center + self.scale * synergy)
        return self.decoder.denormalize(tanh_sum(*self.summands(synergy)))

    def summands(self, synergy: Tensor) -> tuple[Tensor, Tensor]:
        """Contributions of synergies and residual, [*, n] each, where bounds are [-1, 1]."""
        synergy, residual = synergy.split([self.decoder.latent_dim, self.decoder.action_dim], -1)
        base = self.decoder.unit(self.center + self.scale * synergy)
        return INSIDE * base, self.residual * residual


class SynergyDecoder(SynergyMap):
    """Decoder of synergy coefficients into muscle actions, in the policy's units.

    A policy outputs u ∈ [-1, 1]^d and the latent is center + scale·u. :meth:`from_gmvae` fits
    center and scale so that this box covers the latents of recorded actions.

    With ``residual=ρ > 0`` the synergy key has d + n entries. The last n are a raw action in
    [-1, 1]^n that moves each muscle directly, by at most ρ times its half range from the middle.
    It is added before the bounds (:func:`~torchrl_etl.functional.tanh_sum`), so with ρ = 1 every
    action can be reached from any coefficients.

    Equation: a = Dec(z^a) of section 4.2.

    Deviates: the paper gives no range for z^a and no residual.

    Args:
        num_synergies (int): number d of synergies.
        action_dim (int): number n of actuators.

    Keyword Args:
        low, high (float, sequence of float or Tensor): action bounds.
        hidden (sequence of int): widths of the decoder's hidden layers.
        residual (float): ρ in [0, 1]. Default: 0 (no residual).
        in_keys (sequence of NestedKey): the coefficients. Default: ``("synergy",)``.
        out_keys (sequence of NestedKey): the action. Default: ``("action",)``.

    Keys:
        reads ``synergy`` [*, d] (or [*, d+n]) in [-1, 1]; writes ``action`` [*, n] in [low, high].

    Raises:
        ValueError: if a size is not positive or ρ is outside [0, 1].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import GMVAE, SynergyDecoder
        >>> gmvae = GMVAE(action_dim=39, latent_dim=4)
        >>> decoder = SynergyDecoder.from_gmvae(gmvae, actions=torch.rand(256, 39))
        >>> decoder(TensorDict({"synergy": torch.zeros(2, 4)}, [2]))["action"].shape
        torch.Size([2, 39])
        >>> decoder.synergy_spec.shape
        torch.Size([4])
    """

    def __init__(
        self,
        num_synergies: int,
        action_dim: int,
        *,
        low: float | Sequence[float] | Tensor = -1.0,
        high: float | Sequence[float] | Tensor = 1.0,
        hidden: Sequence[int] = (128, 128),
        residual: float = 0.0,
        in_keys: Sequence[NestedKey] = ("synergy",),
        out_keys: Sequence[NestedKey] = ("action",),
    ) -> None:
        if not 0.0 <= residual <= 1.0:
            raise ValueError(
                f"residual is {residual}; it must be in [0, 1], the share of an actuator's half "
                "range that the policy may move directly."
            )
        decoder = ActionDecoder(num_synergies, action_dim, low=low, high=high, hidden=hidden)
        super().__init__(
            _ScaledDecoder(decoder, residual),
            in_keys,
            out_keys,
        )
        self.num_synergies, self.action_dim, self.residual = num_synergies, action_dim, residual

    @classmethod
    def from_gmvae(
        cls,
        gmvae: GMVAE,
        actions: Tensor | np.ndarray | None = None,
        *,
        residual: float = 0.0,
        **keys: Any,
    ) -> SynergyDecoder:
        """Copy a GMVAE's decoder, and the GMVAE itself as :attr:`encoder`.

        Args:
            gmvae (GMVAE): the fitted model; not modified.
            actions (array, optional): actions [N, n] that it was fitted on, see
                :func:`~torchrl_etl.modules.recorded_actions.as_actions`. The box of coefficients
                then spans the 1st to 99th percentile of their latents in each dimension; without
                actions it spans two standard deviations of the mixture prior.

        Keyword Args:
            residual (float): see the class.
            in_keys, out_keys: see the class.
        """
        if actions is not None:
            actions = as_actions(actions, low=gmvae.low, high=gmvae.high, min_rows=2)
        decoder = cls(
            gmvae.latent_dim,
            gmvae.action_dim,
            low=gmvae.low.tolist(),
            high=gmvae.high.tolist(),
            hidden=gmvae.decoder.hidden,
            residual=residual,
            **keys,
        ).to(gmvae.low)  # device and dtype
        scaled = decoder.module
        scaled.decoder.load_state_dict(deepcopy(gmvae.decoder.state_dict()))
        with torch.no_grad():
            if actions is None:
                low = (gmvae.prior_loc - 2 * gmvae.prior_scale).amin(0)
                high = (gmvae.prior_loc + 2 * gmvae.prior_scale).amax(0)
                center, scale = (high + low) / 2, (high - low) / 2
            else:
                center, scale = percentile_box(
                    gmvae.infer(actions[:: 1 + len(actions) // _MOST_ROWS])
                )
            scaled.center.copy_(center)
            scaled.scale.copy_(scale.clamp_min(1e-6))
        decoder.set_encoder(gmvae)
        return decoder

    @classmethod
    def from_directions(
        cls,
        center: Tensor,
        directions: Tensor,
        *,
        low: float | Sequence[float] | Tensor = -1.0,
        high: float | Sequence[float] | Tensor = 1.0,
        residual: float = 0.0,
        **keys: Any,
    ) -> SynergyDecoder:
        """Affine map squashed into the bounds: a decoder without hidden layers.

        It is nearly linear around its center and saturates where a muscle nears its bounds.

        Equation: a = tanh(x + u·X) where the bounds are [-1, 1], with x and X such that Dec(0) is
        the center and ∂Dec(u)/∂u at 0 the directions.

        Args:
            center (Tensor): action [n] at zero coefficients, inside the bounds.
            directions (Tensor): change of the action per unit of each coefficient [d, n], at the
                center and in action units.

        Keyword Args:
            low, high, residual, in_keys, out_keys: see the class.

        Raises:
            ValueError: if the shapes do not match, or the center is not inside the bounds.

        Examples:
            >>> import torch
            >>> decoder = SynergyDecoder.from_directions(
            ...     torch.tensor([0.0, 0.5]), torch.tensor([[0.1, -0.1]])
            ... )
            >>> decoder(torch.tensor([[0.0], [0.01]]))
            tensor([[0.0000, 0.5000],
                    [0.0010, 0.4990]], grad_fn=...)
        """
        if center.ndim != 1 or directions.ndim != 2 or directions.shape[1] != len(center):
            raise ValueError(
                f"center has shape {list(center.shape)} and directions {list(directions.shape)}; "
                "they must be [actuators] and [synergies, actuators]."
            )
        count, muscles = directions.shape
        decoder = cls(count, muscles, low=low, high=high, hidden=(), residual=residual, **keys)
        scaled = decoder.to(directions).module
        unit = scaled.decoder.normalize(center)
        if not (unit.abs() < 1).all():
            raise ValueError(
                f"Entry {int((~(unit.abs() < 1)).nonzero()[0])} of center is not inside the action "
                "bounds, so no synergy could move it; move it inside."
            )
        slope = 2 / (scaled.decoder.high - scaled.decoder.low) / (1 - unit.square())
        (layer,) = (m for m in scaled.decoder.modules() if isinstance(m, nn.Linear))
        with torch.no_grad():
            layer.weight.copy_((directions * slope).mT)
            layer.bias.copy_(unit.atanh())
        return decoder

    def log_slope(self, synergy: Tensor) -> Tensor:
        if not self.residual:
            return super().log_slope(synergy)
        return tanh_sum_log_slope(*self.module.summands(synergy)).sum(-1)

    @property
    def is_affine(self) -> bool:
        """Whether it is affine before the bounds, as from :meth:`from_directions`."""
        return not self.module.decoder.hidden

    @torch.no_grad()
    def encode(self, action: Tensor | np.ndarray) -> Tensor:
        """Coefficients [*, d] of actions [*, n], clamped to the policy's box [-1, 1]^d.

        For an affine decoder, the least squares within this box before the bounds, with actions
        clamped to 0.99 of their half range. Any other decoder uses its :attr:`encoder`, also after
        fine-tuning.

        Raises:
            RuntimeError: if the decoder is not affine and has no encoder.
        """
        action = as_actions(action, low=self.low, high=self.high)
        scaled = self.module
        if self.is_affine:
            (layer,) = (m for m in scaled.decoder.modules() if isinstance(m, nn.Linear))
            unit = scaled.decoder.normalize(action).clamp(-NEAREST, NEAREST)
            offset = layer.bias + layer.weight @ scaled.center
            return bounded_least_squares(layer.weight * scaled.scale, unit.atanh() - offset)
        if self.encoder is not None:
            latent = self.encoder.infer(action)
            return ((latent - scaled.center) / scaled.scale).clamp(-1, 1)
        raise RuntimeError(
            "This decoder has no encoder, so actions cannot be turned into its coefficients; "
            "make it with SynergyDecoder.from_gmvae, or load a bundle that holds one."
        )

    @property
    def config(self) -> dict[str, Any]:
        own = {"hidden": list(self.module.decoder.hidden), "residual": self.residual}
        return super().config | own

    @property
    def low(self) -> Tensor:
        return self.module.decoder.low

    @property
    def high(self) -> Tensor:
        return self.module.decoder.high
