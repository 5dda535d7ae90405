"""Non-negative synergies, as in the motor control literature."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_etl.checks import check_integer
from torchrl_etl.synergies.affine import AffineSynergies
from torchrl_etl.synergies.factors import ignore_convergence_warnings, make_nmf

__all__ = ["NMFSynergies"]


class NMFSynergies(AffineSynergies):
    """Non-negative matrix factorization of actions relative to their lower bounds.

    The model is a = low + c·basis with c, basis ≥ 0 (Lee and Seung, 1999; d'Avella et al., 2003).
    The decoder matches the model's action and slope at the middle of the box of coefficients.
    Where the model would exceed the bounds of a muscle, the decoder saturates smoothly.

    Keyword Args:
        max_iter (int): maximum number of iterations.

    Examples:
        >>> _ = torch.manual_seed(0)
        >>> parts = torch.tensor([[0.9, 0.0, 0.5, 0.1], [0.0, 0.4, 0.4, 0.8]])
        >>> activity = torch.rand(512, 2) / 2 @ parts  # of four muscles, in [0, 1]
        >>> model = NMFSynergies(torch.zeros(4), torch.ones(4), 2)
        >>> model.fit(activity)
        >>> torch.allclose(model.reconstruct(activity), activity, atol=0.02)
        True
        >>> bool((model.basis >= 0).all())
        True
    """

    kind = "nmf"
    # Above, the slope before the bounds is so steep that a small change of a coefficient moves a
    # muscle from one bound to the other.
    highest = 0.9

    def __init__(
        self, low: Tensor, high: Tensor, num_synergies: int, *, max_iter: int = 500
    ) -> None:
        check_integer(1, max_iter=max_iter)
        super().__init__(low, high, num_synergies)
        self.max_iter = max_iter

    def factorize(self, actions: np.ndarray) -> np.ndarray:
        self.model = make_nmf(self.num_synergies, self.max_iter)
        above = self._above_low(actions)
        # The factorization fails on all zeros, as when no muscle is ever active.
        above[0] += 1e-9 * (not above.any())
        self._unit = above.max()
        with ignore_convergence_warnings():
            self.model.fit(above / self._unit)
        return self._unit * self.model.components_

    def coefficients(self, actions: Tensor) -> Tensor:
        rows = actions.detach().reshape(-1, len(self.low)).cpu().double().numpy()
        with ignore_convergence_warnings():
            found = torch.as_tensor(self.model.transform(self._above_low(rows) / self._unit))
        return found.to(self.low).reshape(*actions.shape[:-1], self.num_synergies)

    def compose(self, coefficients: Tensor) -> Tensor:
        return self.low + coefficients @ self.basis

    def _above_low(self, actions: np.ndarray) -> np.ndarray:
        return (actions - self.low.cpu().double().numpy()).clip(min=0.0)
