"""Exploration by random network distillation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn
from torchrl.envs.transforms import Transform
from torchrl.envs.transforms.rnd import RunningMeanStd
from torchrl.modules import MLP
from torchrl.objectives import RNDLoss

from torchrl_etl.checks import check_integer, check_sizes, naming
from torchrl_etl.envs import EnvironmentSpec
from torchrl_etl.exploration.exploration import Exploration
from torchrl_etl.learners.term import Term
from torchrl_etl.transforms import RNDBonus

__all__ = ["RNDExploration"]


class RNDExploration(Exploration):
    """Rewards rarely seen observations, whose random features are predicted badly (Burda 2018).

    TorchRL's loss is used on whole batches; the paper masks three quarters of the data from its
    many simulators. Nothing is drawn at reset, and the policy reads only the observation.

    Equation: see :class:`~torchrl_etl.transforms.RNDBonus`.

    Keyword Args:
        features (int): outputs of the random network.
        hidden (sequence of int): widths of its layers and of the predictor's.
        lr (float, optional): learning rate of the predictor; ``None``: the learner's.
        bonus (mapping): keyword arguments of :class:`~torchrl_etl.transforms.ScaledBonus`.
    """

    reward = "intrinsic_reward"

    def __init__(
        self,
        spec: EnvironmentSpec,
        *,
        features: int,
        hidden: Sequence[int],
        lr: float | None,
        bonus: Mapping[str, Any],
    ) -> None:
        super().__init__(spec)
        check_integer(1, features=features)
        check_sizes(hidden=hidden)
        target, predictor = (
            MLP(spec.observation_dim, features, num_cells=hidden, activation_class=nn.ReLU)
            for _ in range(2)
        )
        statistics = RunningMeanStd((spec.observation_dim,))
        loss = RNDLoss(predictor, target, obs_rms=statistics, update_fraction=1.0)
        self.loss = loss.to(spec.device)
        self._term = Term(self.loss, lr=lr)
        with naming("bonus"):
            self._bonus = RNDBonus(self.loss, **bonus)

    def batch_transforms(self) -> Sequence[Transform]:
        return (self._bonus,)

    def terms(self) -> Sequence[Term]:
        return (self._term,)
