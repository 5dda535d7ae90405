"""What finds synergies in actions."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies.bundle import save_bundle

__all__ = ["SynergyModel"]


class SynergyModel(ABC):
    """Condenses actions of n actuators into d coefficients.

    A subclass is a file of its own that a configuration names by its kind; ``docs/extend.md`` adds
    one. It is built from the bounds of the action: ``Model(low, high, num_synergies, **options)``.

    Attributes:
        kind (str): its name in configurations and bundles.
        loss (LossModule, optional): trained beside stage 1 on entry ``action``; ``None`` for a
            model that is fitted once, when all actions are known.
        lr (float): learning rate of the loss.
        updates (int): of :meth:`fit`, where it trains; the picture of VAF sets it for its models.
    """

    kind: ClassVar[str]
    num_synergies: int
    loss: LossModule | None = None
    lr: float = 1e-3
    updates: int = 2000

    @abstractmethod
    def fit(self, actions: Tensor, *, on_update: Callable[[], None] = lambda: None) -> None:
        """Fit to actions [N, n], from anew.

        Keyword Args:
            on_update (callable): called now and then; may raise to stop.
        """

    @abstractmethod
    def decoder(self, actions: Tensor, *, residual: float = 0.0) -> SynergyDecoder:
        """The map from coefficients in [-1, 1]^d to actions, which spans ``actions`` [N, n]."""

    @abstractmethod
    def reconstruct(self, actions: Tensor) -> Tensor:
        """Actions [*, n] rebuilt from their d coefficients."""

    def describe(self, actions: Tensor) -> tuple[dict[str, float], list[str]]:
        """What a kind knows of itself on actions [N, n]: numbers, and in words what is wrong.

        What every kind has is in :func:`~torchrl_etl.analysis.describe_synergies`, which adds this.
        Which muscles a synergy moves is the decoder's to tell: it has no model once it is loaded.
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
        """Leave a bundle of the decoder that spans ``actions`` [N, n], with this model's kind.

        Args:
            path, task, actuators, facts: see :func:`~torchrl_etl.synergies.save_bundle`.
        """
        decoder = self.decoder(actions)
        return save_bundle(
            decoder, path, task=task, actuators=actuators, facts=facts, kind=self.kind
        )
