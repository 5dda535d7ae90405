"""Learners: networks, losses, targets and optimizer behind one update."""

from torchrl_etl.learners.ema import WarmedUpEMA
from torchrl_etl.learners.objective import NORMALIZED, Objective
from torchrl_etl.learners.policy import from_observation
from torchrl_etl.learners.sac import SACLearner
from torchrl_etl.learners.stacked import StackedLearners
from torchrl_etl.learners.term import Term

__all__ = [
    "NORMALIZED",
    "Objective",
    "SACLearner",
    "StackedLearners",
    "Term",
    "WarmedUpEMA",
    "from_observation",
]
