"""Exploration in a behavioral-metric space: the paper's (Eqs. 1 to 6)."""

from __future__ import annotations

from collections.abc import Sequence
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
        metric: dict[str, Any],
        **directions: Any,
    ) -> None:
        super().__init__(spec, **directions)
        check_real("(0, 1]", tau=tau)  # Term also allows None, for no targets
        check_flag(**{"metric.delay_encoder": metric.get("delay_encoder", True)})
        self._lr, self._tau, self._metric = lr, tau, dict(metric)

    def terms(self) -> Sequence[Term]:
        dynamics = None
        if self._metric.get("divergence") == "gaussian":
            dynamics = GaussianDynamics(self.encoder.embedding_dim)
        device = next(self.encoder.parameters()).device
        with naming("metric"):
            loss = BehavioralMetricLoss(self.encoder, dynamics, **self._metric).to(device)
        tau = self._tau if self._metric.get("delay_encoder", True) else None
        return (Term(loss, lr=self._lr, tau=tau),)
