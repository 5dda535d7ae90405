"""DynSyn whose groups hold muscles that do not move alike: a control of what its grouping is worth.

    python recipes/etl_sac.py method=dynsyn method.kind=studies.shuffled_groups:ShuffledGroups

Everything else is DynSyn's: number and sizes of the groups, noise, deviations, the charge.
"""

from __future__ import annotations

import random

from torchrl_etl.methods.dynsyn import DynSyn
from torchrl_etl.training.loop import StopOnSignal


class ShuffledGroups(DynSyn):
    """Deals the groups that DynSyn found to the muscles at random, by the run's seed."""

    def found_groups(self, stop: StopOnSignal) -> list[int]:
        groups = super().found_groups(stop)
        random.Random(self.context.config.seed).shuffle(groups)
        return groups
