"""Base class of synergy models with a linear basis, fitted in one call."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.modules.recorded_actions import as_actions
from torchrl_etl.modules.synergy_decoder import NEAREST, percentile_box
from torchrl_etl.synergies.model import SynergyModel, check_num_synergies

__all__ = ["AffineSynergies"]


class AffineSynergies(SynergyModel):
    """A model that maps coefficients to actions through a basis [d, n], perhaps before the bounds.

    A subclass defines how to fit the basis (:meth:`factorize`), how to encode actions
    (:meth:`coefficients`) and how to decode coefficients (:meth:`compose`). The decoder comes from
    :meth:`~torchrl_etl.modules.SynergyDecoder.from_directions`, with the slope of :meth:`compose`
    at the middle of the box. The box spans the 1st to 99th percentile of each coefficient.

    Args:
        low, high (Tensor): bounds of the action [n].
        num_synergies (int): d, at most n.

    Raises:
        ValueError: if d is not between 1 and n.
    """

    basis: Tensor | None = None
    highest: ClassVar[float] = NEAREST
    """Largest action at the middle of the box, in units where the bounds are ±1."""
    most_rows: int = 20_000
    """Actions in :meth:`fit`; of more, a regular stride is taken."""

    def __init__(self, low: Tensor, high: Tensor, num_synergies: int) -> None:
        check_num_synergies(num_synergies, len(low))
        self.low, self.high, self.num_synergies = low, high, num_synergies

    @abstractmethod
    def factorize(self, actions: np.ndarray) -> np.ndarray:
        """Fit the basis [d, n] to actions [N, n] in double precision."""

    @abstractmethod
    def coefficients(self, actions: Tensor) -> Tensor:
        """Coefficients [*, d] of actions [*, n], at any scale."""

    @abstractmethod
    def compose(self, coefficients: Tensor) -> Tensor:
        """Actions [*, n] of coefficients [*, d]."""

    def fit(self, actions: Tensor, *, on_update: Callable[[], None] = lambda: None) -> None:
        on_update()
        least = max(2, self.num_synergies)
        rows = as_actions(actions, low=self.low, high=self.high, min_rows=least)
        rows = rows[:: 1 + (len(rows) - 1) // self.most_rows]
        basis = self.factorize(rows.detach().cpu().double().numpy())
        self.basis = torch.as_tensor(basis).to(self.low)

    def decoder(self, actions: Tensor, *, residual: float = 0.0) -> SynergyDecoder:
        self._check_fitted()
        actions = as_actions(actions, low=self.low, high=self.high, min_rows=2)
        middle, half = percentile_box(self.coefficients(actions))
        slope = torch.func.jacrev(self.compose)(middle)
        return SynergyDecoder.from_directions(
            self.inside(self.compose(middle)),
            half[:, None] * slope.mT,
            low=self.low.tolist(),
            high=self.high.tolist(),
            residual=residual,
        )

    def inside(self, center: Tensor) -> Tensor:
        """Clamp the action [n] at the middle of the box to lie inside the bounds."""
        half = (self.high - self.low) / 2
        unit = (center - self.low) / half - 1
        return self.low + half * (unit.clamp(-NEAREST, self.highest) + 1)

    def reconstruct(self, actions: Tensor) -> Tensor:
        self._check_fitted()
        actions = as_actions(actions, low=self.low, high=self.high)
        return self.compose(self.coefficients(actions))

    def _check_fitted(self) -> None:
        if self.basis is None:
            raise RuntimeError(f"The {self.kind} has no synergies yet; call fit(actions) first.")
