"""Modules of a behavior policy that depend on how far a run is."""

from __future__ import annotations

__all__ = ["Scheduled"]


class Scheduled:
    """Base class of modules that a learner tells how far the run is.

    :class:`~torchrl_etl.learners.SACLearner` does so for every such module in its behavior policy,
    in this process; workers get copies when they start, later only new weights and buffers.
    """

    def restart(self, actions: int) -> None:
        """New episodes begin in all simulators, after ``actions`` actions of each worker."""

    def advance(self, frames: int) -> None:
        """A batch was collected; the stage has ``frames`` frames now."""
