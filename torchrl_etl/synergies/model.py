"""Base class of synergy models."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_etl.checks import check_integer
from torchrl_etl.modules import SynergyMap
from torchrl_etl.synergies.bundle import save_bundle

__all__ = ["SynergyModel", "check_num_synergies"]


def check_num_synergies(num_synergies: int, actuators: int) -> None:
    """Raise ``TypeError`` or ``ValueError`` unless it is an integer from 1 to ``actuators``."""
    check_integer(1, num_synergies=num_synergies)
    if num_synergies > actuators:
        raise ValueError(
            f"num_synergies is {num_synergies} but there are only {actuators} actuators; "
            f"choose at most {actuators}."
        )


class SynergyModel(ABC):
    """Encodes actions of n actuators as d coefficients.

    Each subclass has its own file, and configurations select it by its kind; ``docs/extend.md``
    adds one. The constructor is ``Model(low, high, num_synergies, **options)`` with action bounds.

    Attributes:
        kind (str): name in configurations and bundles.
        loss (LossModule, optional): trained during stage 1 on the entry ``action``; ``None`` for a
            model that is fitted once, on all actions.
        lr (float): learning rate of the loss.
        updates (int, optional): updates in :meth:`fit`, of the class; ``fit_synergies`` and the VAF
            figure override it. ``None`` for a model that does not train.
    """

    kind: ClassVar[str]
    num_synergies: int
    loss: LossModule | None = None
    lr: float = 1e-3
    updates: int | None = None

    @abstractmethod
    def fit(self, actions: Tensor, *, on_update: Callable[[], None] = lambda: None) -> None:
        """Fit to actions [N, n] from scratch.

        Keyword Args:
            on_update (callable): called at intervals; may raise to stop.
        """

    @abstractmethod
    def decoder(self, actions: Tensor, *, residual: float = 0.0) -> SynergyMap:
        """The map from coefficients in [-1, 1]^d to actions, scaled to span ``actions`` [N, n]."""

    @abstractmethod
    def reconstruct(self, actions: Tensor) -> Tensor:
        """Actions [*, n] reconstructed from their d coefficients."""

    def describe(self, actions: Tensor) -> tuple[dict[str, float], list[str]]:
        """Diagnostics specific to this kind on actions [N, n]: numbers, and warnings as text.

        :func:`~torchrl_etl.analysis.describe_synergies` adds them to the diagnostics of all kinds.
        Which muscles a synergy moves is computed from the decoder, as a bundle has no model.
        """
        return {}, []

    def save(
        self,
        path: str | os.PathLike[str],
        actions: Tensor,
        *,
        task: str,
        actuators: Sequence[str],
        facts: Mapping[str, Any] | None = None,
    ) -> Path:
        """Save a bundle with this model's kind and its decoder for ``actions`` [N, n].

        Args:
            path, task, actuators, facts: see :func:`~torchrl_etl.synergies.save_bundle`.
        """
        decoder = self.decoder(actions)
        return save_bundle(
            decoder, path, task=task, actuators=actuators, facts=facts, kind=self.kind
        )
