"""Exploration under METRA's constraint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_etl.checks import naming
from torchrl_etl.envs import EnvironmentSpec
from torchrl_etl.exploration.directions import DirectionExploration
from torchrl_etl.learners.term import Term
from torchrl_etl.objectives import METRALoss

__all__ = ["METRAExploration"]


class METRAExploration(DirectionExploration):
    """φ maximizes the bonus itself while its steps stay within length one (Park 2024).

    Equation: see :class:`~torchrl_etl.objectives.METRALoss`.

    Keyword Args:
        lr (float, optional): learning rate of φ and of the multiplier; ``None``: the learner's.
        metra (mapping): keyword arguments of the loss.
        **directions: see :class:`~torchrl_etl.exploration.DirectionExploration`.
    """

    def __init__(
        self,
        spec: EnvironmentSpec,
        *,
        lr: float | None,
        metra: Mapping[str, Any],
        **directions: Any,
    ) -> None:
        super().__init__(spec, **directions)
        with naming("metra"):
            loss = METRALoss(self.encoder, **metra).to(spec.device)
        self._term = Term(loss, lr=lr)

    def terms(self) -> Sequence[Term]:
        return (self._term,)
