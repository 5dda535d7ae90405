"""What kinds of synergies share that add up, through a basis that is found in one go."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torchrl_etl.checks import check_integer
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.modules.recorded_actions import as_actions
from torchrl_etl.modules.synergy_decoder import NEAREST, percentile_box
from torchrl_etl.synergies.model import SynergyModel

__all__ = ["AffineSynergies"]

_MOST_ROWS = 20_000


class AffineSynergies(SynergyModel):
    """A model whose coefficients a basis [d, n] turns into actions, perhaps before the bounds.

    A subclass says how it factorizes (:meth:`factorize`), and how actions become coefficients
    (:meth:`coefficients`) and coefficients actions (:meth:`compose`). The decoder is
    :meth:`~torchrl_etl.modules.SynergyDecoder.from_directions` with the slope of :meth:`compose` in
    the middle of the box, which spans the 1st to the 99th percentile of each coefficient.

    Args:
        low, high (Tensor): bounds of the action [n].
        num_synergies (int): d, at most n.

    Raises:
        ValueError: if d is not between 1 and n.
    """

    basis: Tensor | None = None
    highest: ClassVar[float] = NEAREST
    """As far up as a muscle may be in the middle of the box, where the bounds are ±1."""

    def __init__(self, low: Tensor, high: Tensor, num_synergies: int) -> None:
        check_integer(1, num_synergies=num_synergies)
        if num_synergies > len(low):
            raise ValueError(
                f"num_synergies is {num_synergies} but there are only {len(low)} actuators; "
                f"choose at most {len(low)}."
            )
        self.low, self.high, self.num_synergies = low, high, num_synergies

    @abstractmethod
    def factorize(self, actions: np.ndarray) -> np.ndarray:
        """The basis [d, n] of actions [N, n], which are in double precision."""

    @abstractmethod
    def coefficients(self, actions: Tensor) -> Tensor:
        """Coefficients [*, d] of actions [*, n], on no particular scale."""

    @abstractmethod
    def compose(self, coefficients: Tensor) -> Tensor:
        """Actions [*, n] of coefficients [*, d]."""

    def fit(self, actions: Tensor, *, on_update: Callable[[], None] = lambda: None) -> None:
        """See the base class; of more than 20,000 actions every second, third, ... is taken."""
        on_update()
        least = max(2, self.num_synergies)
        rows = as_actions(actions, low=self.low, high=self.high, min_rows=least)
        rows = rows[:: 1 + (len(rows) - 1) // _MOST_ROWS]
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
        """The action [n] in the middle of the box, brought inside the bounds if need be."""
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
