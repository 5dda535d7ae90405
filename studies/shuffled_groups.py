"""DynSyn with randomly assigned muscle groups, a control for the value of its grouping.

    python recipes/etl_sac.py method=dynsyn method.kind=studies.shuffled_groups:ShuffledGroups

All else is as in DynSyn: number and sizes of groups, noise, deviations, charged frames.
"""

from __future__ import annotations

import random

from torchrl_etl.methods.dynsyn import DynSyn
from torchrl_etl.training.loop import StopOnSignal


class ShuffledGroups(DynSyn):
    """Permutes DynSyn's groups over the muscles, with the run's seed."""

    def found_groups(self, stop: StopOnSignal) -> list[int]:
        groups = super().found_groups(stop)
        random.Random(self.context.config.seed).shuffle(groups)
        return groups
