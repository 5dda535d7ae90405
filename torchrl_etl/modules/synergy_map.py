"""Interface of maps from synergy coefficients to muscle actions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, Self

import numpy as np
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded

from torchrl_etl.modules.calls import as_keys
from torchrl_etl.modules.gmvae import GMVAE

__all__ = ["SynergyMap"]


class SynergyMap(TensorDictModule):
    """Base class of maps from bounded synergy coefficients to muscle actions.

    Calling it decodes; :meth:`log_slope` corrects the policy's entropy for the residual;
    :meth:`encode` relabels recorded actions. Bundles and zoo entries hold a map as its
    :attr:`config` and its state dict, so its constructor takes these arguments by name, and
    optionally ``in_keys`` and ``out_keys``. With ``residual`` among them, a loaded map can be given
    another one.

    Attributes:
        num_synergies (int): number d of synergies.
        action_dim (int): number n of actuators.
        residual (float): share of an actuator's range that the policy moves directly; 0: none.
        low, high (Tensor): bounds of the action [n].
        encoder (GMVAE, optional): frozen copy of the model that the map was made from. It is not a
            submodule, so it is neither trained nor in the state dict. With another map's weights,
            also call ``set_encoder(other.encoder)``.
    """

    num_synergies: int
    action_dim: int
    residual: float
    low: Tensor
    high: Tensor
    encoder: GMVAE | None = None

    def __init__(
        self,
        module: nn.Module,
        in_keys: NestedKey | Sequence[NestedKey],
        out_keys: NestedKey | Sequence[NestedKey],
    ) -> None:
        super().__init__(module, as_keys(in_keys), as_keys(out_keys))

    def log_slope(self, synergy: Tensor) -> Tensor:
        """ln |det ∂a/∂r| [*] of the action a by the residual r, at ``synergy`` [*, d+n].

        Relative to synergies that put every muscle in the middle of its range. 0 by default, for
        maps without a residual, or with one that moves the action equally far everywhere.
        """
        return synergy.new_zeros(synergy.shape[:-1])

    @abstractmethod
    def encode(self, action: Tensor | np.ndarray) -> Tensor:
        """Coefficients in [-1, 1]^d that approximate actions [*, n] with zero residual.

        Returns:
            Tensor: [*, d], without gradients or entries of a residual.

        Raises:
            TypeError, ValueError: see :func:`~torchrl_etl.modules.recorded_actions.as_actions`.
        """

    def set_encoder(self, encoder: GMVAE | None) -> None:
        """Keep a frozen copy of this model from now on."""
        if encoder is not None:
            encoder = deepcopy(encoder).requires_grad_(False)
        object.__setattr__(self, "encoder", encoder)  # not as a submodule

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        if self.encoder is not None:  # moves to the same device and dtype
            self.encoder._apply(fn, recurse)
        return super()._apply(fn, recurse)

    @property
    def config(self) -> dict[str, Any]:
        """JSON-able arguments: ``Map(**config)`` plus a state dict rebuilds it."""
        return {
            "num_synergies": self.num_synergies,
            "action_dim": self.action_dim,
            "low": self.low.tolist(),
            "high": self.high.tolist(),
        }

    @property
    def synergy_dim(self) -> int:
        """Entries of the synergy key: d, or d + n with a residual."""
        return self.num_synergies + (self.action_dim if self.residual else 0)

    @property
    def synergy_spec(self) -> Bounded:
        """Action spec of a policy: [-1, 1] in each entry, unbatched."""
        return Bounded(-1.0, 1.0, shape=(self.synergy_dim,), device=self.low.device)
