"""SAR's map from synergy coefficients to muscle actions (Berg 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_etl.functional import bounded_least_squares
from torchrl_etl.modules.recorded_actions import as_actions, as_bounds
from torchrl_etl.modules.synergy_map import SynergyMap

__all__ = ["SARDecoder"]


class _BlendedBasis(nn.Module):
    """z ∈ [-1, 1]^d → mean + z·basis, blended with a raw action and clamped to the bounds."""

    mean: Tensor
    basis: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, num_synergies: int, low: Tensor, high: Tensor, blend: float) -> None:
        super().__init__()
        self.blend = blend
        self.register_buffer("mean", torch.zeros_like(low))
        self.register_buffer("basis", low.new_zeros(num_synergies, len(low)))
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def forward(self, synergy: Tensor) -> Tensor:
        synergy = synergy.to(self.basis.dtype)
        if self.blend == 1:
            return (self.mean + synergy @ self.basis).clamp(self.low, self.high)
        synergy, raw = synergy.split(list(self.basis.shape), -1)
        raw = self.low + (raw + 1) / 2 * (self.high - self.low)
        action = self.blend * (self.mean + synergy @ self.basis) + (1 - self.blend) * raw
        return action.clamp(self.low, self.high)


class SARDecoder(SynergyMap):
    """Decodes synergy coefficients into muscle actions by a fixed affine map.

    It can replace a :class:`~torchrl_etl.modules.SynergyDecoder`, but has only buffers and no
    parameters. They are zero until loaded or set: make one with :meth:`from_basis`, or from
    recorded actions with :meth:`torchrl_etl.synergies.SARSynergies.blended_decoder`.

    With a ``blend`` φ below 1 the synergy key has d + n entries. The last n are a raw action in
    [-1, 1]^n.

    Equation: a = φ·inverse(z) + (1 - φ)·a_raw, clamped to the bounds, where inverse undoes the
    scaling, the independent and the principal components. Noise that the clamp hides counts as
    entropy, as in the public code.

    Deviates: the paper's critics value the coefficients and the raw action; under
    :class:`~torchrl_etl.objectives.SynergySACLoss` they value the executed action.

    Args:
        num_synergies (int): number d of synergies.
        action_dim (int): number n of actuators.

    Keyword Args:
        low, high (float, sequence of float or Tensor): action bounds, one or [n].
            Default: -1 and 1.
        blend (float): φ in (0, 1]; the paper uses 0.66 for hands and 1 (synergies only) for legs.
            Default: 0.66.
        in_keys (sequence of NestedKey): the coefficients. Default: ``("synergy",)``.
        out_keys (sequence of NestedKey): the action. Default: ``("action",)``.

    Keys:
        reads ``synergy`` [*, d+n] (or [*, d] with ``blend=1``) in [-1, 1]; writes ``action`` [*, n]
        in [low, high].

    Raises:
        ValueError: if φ is outside (0, 1], or shapes or bounds do not fit.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> decoder = SARDecoder(num_synergies=3, action_dim=39, blend=0.66)
        >>> decoder.synergy_spec.shape
        torch.Size([42])
        >>> decoder(TensorDict({"synergy": torch.zeros(2, 42)}, [2]))["action"].shape
        torch.Size([2, 39])
    """

    def __init__(
        self,
        num_synergies: int,
        action_dim: int,
        *,
        low: float | Sequence[float] | Tensor = -1.0,
        high: float | Sequence[float] | Tensor = 1.0,
        blend: float = 0.66,
        in_keys: Sequence[NestedKey] = ("synergy",),
        out_keys: Sequence[NestedKey] = ("action",),
    ) -> None:
        if not 0.0 < blend <= 1.0:
            raise ValueError(
                f"blend is {blend}; it must be in (0, 1], the share of the synergies in an action "
                "(in the paper 0.66 for hands and 1 for legs)."
            )
        bounds = as_bounds(low, high, action_dim)
        super().__init__(
            _BlendedBasis(num_synergies, *bounds, blend),
            in_keys,
            out_keys,
        )
        self.num_synergies, self.action_dim = num_synergies, action_dim
        self.residual = 1.0 - blend  # the share of an actuator's range that the raw action has

    @classmethod
    def from_basis(cls, mean: Tensor, basis: Tensor, **options: Any) -> SARDecoder:
        """The decoder of a mean and a basis, in their dtype and on their device.

        Args:
            mean (Tensor): the action at z = 0 [n].
            basis (Tensor): change of the action per unit of each coefficient [d, n].

        Keyword Args:
            low, high, blend, in_keys, out_keys: see the class.

        Raises:
            ValueError: if the shapes do not match.

        Examples:
            >>> decoder = SARDecoder.from_basis(torch.zeros(2), torch.ones(1, 2) / 4, blend=1.0)
            >>> decoder(torch.tensor([-1.0]))
            tensor([-0.2500, -0.2500])
        """
        if mean.ndim != 1 or basis.ndim != 2 or basis.shape[1] != len(mean):
            raise ValueError(
                f"mean has shape {list(mean.shape)} and basis {list(basis.shape)}; they must be "
                "[actuators] and [synergies, actuators]."
            )
        decoder = cls(*basis.shape, **options).to(basis)
        decoder.module.mean.copy_(mean.detach())
        decoder.module.basis.copy_(basis.detach())
        return decoder

    @torch.no_grad()
    def encode(self, action: Tensor | np.ndarray) -> Tensor:
        """Coefficients [*, d] of actions [*, n] by least squares within [-1, 1]."""
        action = as_actions(action, low=self.low, high=self.high)
        middle = (self.low + self.high) / 2
        synergies = (action - self.residual * middle) / self.module.blend - self.module.mean
        return bounded_least_squares(self.module.basis.mT, synergies)

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"blend": self.module.blend}
