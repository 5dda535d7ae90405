"""Interface of maps from synergy coefficients to muscle actions."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded

__all__ = ["SynergyMap"]


class SynergyMap(TensorDictModule):
    """Base class of maps from bounded synergy coefficients to muscle actions.

    Calling it decodes; :meth:`log_slope` corrects the policy's entropy for the residual;
    :meth:`encode` relabels recorded actions.

    Attributes:
        num_synergies (int): number d of synergies.
        action_dim (int): number n of actuators.
        residual (float): share of an actuator's range that the policy moves directly; 0: none.
        low, high (Tensor): bounds of the action [n].
    """

    num_synergies: int
    action_dim: int
    residual: float
    low: Tensor
    high: Tensor

    @abstractmethod
    def log_slope(self, synergy: Tensor) -> Tensor:
        """ln |det ∂a/∂r| [*] of the action a by the residual r, at ``synergy`` [*, d+n].

        Relative to synergies that put every muscle in the middle of its range; 0 without a
        residual.
        """

    @abstractmethod
    def encode(self, action: Tensor | np.ndarray) -> Tensor:
        """Coefficients in [-1, 1]^d that approximate actions [*, n] with zero residual.

        Returns:
            Tensor: [*, d], without gradients or entries of a residual.

        Raises:
            TypeError, ValueError: see :func:`~torchrl_etl.modules.recorded_actions.as_actions`.
        """

    @property
    def synergy_dim(self) -> int:
        """Entries of the synergy key: d, or d + n with a residual."""
        return self.num_synergies + (self.action_dim if self.residual else 0)

    @property
    def synergy_spec(self) -> Bounded:
        """Action spec of a policy: [-1, 1] in each entry, unbatched."""
        return Bounded(-1.0, 1.0, shape=(self.synergy_dim,), device=self.low.device)
