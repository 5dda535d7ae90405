"""Plain SAC on all actuators: the control condition."""

from __future__ import annotations

from torchrl_etl.methods.method import Method
from torchrl_etl.training.stage import Stage

__all__ = ["SAC"]


class SAC(Method):
    """The learner of ETL's stage 2 without synergies."""

    def stage(self) -> Stage:
        self.context.seed_everything("learn")
        return self.context.stage(self.context.learner())
