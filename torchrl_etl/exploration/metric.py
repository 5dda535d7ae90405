"""Exploration in a behavioral-metric space: the paper's (Eqs. 1 to 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_etl.checks import check_flag, check_real, naming
from torchrl_etl.envs import EnvironmentSpec
from torchrl_etl.exploration.directions import DirectionExploration
from torchrl_etl.learners.term import Term
from torchrl_etl.modules import GaussianDynamics
from torchrl_etl.objectives import BehavioralMetricLoss

__all__ = ["MetricExploration"]


class MetricExploration(DirectionExploration):
    """φ learns distances that compare states by the task's reward and their next states.

    Equation: 2, 3, 5 and 6, see :class:`~torchrl_etl.objectives.BehavioralMetricLoss`.

    Keyword Args:
        lr (float, optional): learning rate of φ; ``None``: the learner's.
        tau (float): EMA rate of the target encoder.
        metric (mapping): keyword arguments of the loss.
        **directions: see :class:`~torchrl_etl.exploration.DirectionExploration`.
    """

    def __init__(
        self,
        spec: EnvironmentSpec,
        *,
        lr: float | None,
        tau: float,
        metric: Mapping[str, Any],
        **directions: Any,
    ) -> None:
        super().__init__(spec, **directions)
        check_real("(0, 1]", tau=tau)  # Term also allows None, for no targets
        delays = metric.get("delay_encoder", True)
        check_flag(**{"metric.delay_encoder": delays})
        dynamics = None
        if metric.get("divergence") == "gaussian":
            dynamics = GaussianDynamics(self.encoder.embedding_dim)
        with naming("metric"):
            loss = BehavioralMetricLoss(self.encoder, dynamics, **metric).to(spec.device)
        self._term = Term(loss, lr=lr, tau=tau if delays else None)

    def terms(self) -> Sequence[Term]:
        return (self._term,)
