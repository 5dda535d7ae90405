"""Synergies as principal components of the actions before their bounds."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_etl.modules.synergy_decoder import NEAREST
from torchrl_etl.synergies.affine import AffineSynergies
from torchrl_etl.synergies.factors import principal_components

__all__ = ["PCASynergies"]


class PCASynergies(AffineSynergies):
    """The mean action and the directions of largest variance, before the bounds.

    The decoder equals the model: a = tanh(mean + c·basis) for bounds of [-1, 1].

    Examples:
        >>> low, high = -torch.ones(8), torch.ones(8)
        >>> _ = torch.manual_seed(0)
        >>> actions = torch.tanh(0.3 + torch.randn(512, 2) @ torch.randn(2, 8) / 4)
        >>> model = PCASynergies(low, high, 2)
        >>> model.fit(actions)
        >>> torch.allclose(model.reconstruct(actions), actions, atol=0.05)
        True
        >>> model.decoder(actions).synergy_spec.shape
        torch.Size([2])
    """

    kind = "pca"

    def factorize(self, actions: np.ndarray) -> np.ndarray:
        before = self._before_bounds(torch.as_tensor(actions)).numpy()
        found = principal_components(before, self.num_synergies, svd_solver="covariance_eigh")
        self.mean = torch.as_tensor(found.mean_).to(self.low)
        return found.components_

    def coefficients(self, actions: Tensor) -> Tensor:
        return (self._before_bounds(actions) - self.mean) @ self.basis.mT

    def compose(self, coefficients: Tensor) -> Tensor:
        unit = (self.mean + coefficients @ self.basis).tanh()
        return self.low + (unit + 1) / 2 * (self.high - self.low)

    def inside(self, center: Tensor) -> Tensor:
        return center  # unchanged, so that the decoder equals the model

    def _before_bounds(self, actions: Tensor) -> Tensor:
        low, high = self.low.to(actions), self.high.to(actions)
        return (2 * (actions - low) / (high - low) - 1).clamp(-NEAREST, NEAREST).atanh()
