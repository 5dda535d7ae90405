"""What ETL asks of whatever turns synergy coefficients into muscle actions."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Bounded

__all__ = ["SynergyMap"]


class SynergyMap(TensorDictModule):
    """What maps synergy coefficients in a box to muscle actions, whatever is inside.

    All that ETL asks of a decoder: call it, and it decodes; :meth:`log_slope` corrects the entropy
    of what the policy moves directly; :meth:`encode` relabels recorded actions.

    Attributes:
        num_synergies (int): number d of synergies.
        action_dim (int): number n of actuators.
        residual (float): share of an actuator that the policy moves directly; 0: none.
        low, high (Tensor): bounds of the action [n].
    """

    num_synergies: int
    action_dim: int
    residual: float
    low: Tensor
    high: Tensor

    @abstractmethod
    def log_slope(self, synergy: Tensor) -> Tensor:
        """How far the action moves with the residual: ln |det ∂a/∂r| [*] at ``synergy`` [*, d+n].

        Relative to where the synergies leave every muscle in the middle of its range; 0 without a
        residual.
        """

    @abstractmethod
    def encode(self, action: Tensor | np.ndarray) -> Tensor:
        """Coefficients in [-1, 1]^d that with a residual of zero come near to actions [*, n].

        Returns:
            Tensor: [*, d], without gradients and without a residual.

        Raises:
            TypeError, ValueError: see :func:`~torchrl_etl.modules.recorded_actions.as_actions`.
        """

    @property
    def synergy_dim(self) -> int:
        """Entries of the synergy key: d, or d + n with a residual."""
        return self.num_synergies + (self.action_dim if self.residual else 0)

    @property
    def synergy_spec(self) -> Bounded:
        """What a policy may emit: [-1, 1] in each entry, unbatched."""
        return Bounded(-1.0, 1.0, shape=(self.synergy_dim,), device=self.low.device)
