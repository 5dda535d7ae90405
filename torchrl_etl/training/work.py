"""Work that pauses wherever an update is due, so that runs can take their updates together."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import NamedTuple, TypeAlias, TypeVar

from tensordict import TensorDictBase

from torchrl_etl.learners import SACLearner

__all__ = ["Due", "Work", "alone"]

Result = TypeVar("Result")


class Due(NamedTuple):
    """An update that a learner has earned, on this batch [B], in the stage of this name."""

    stage: str
    learner: SACLearner
    batch: TensorDictBase


# It yields what is due, is sent the scalars of that update, and returns what it is done for.
Work: TypeAlias = Generator[Due, TensorDictBase, Result]


def alone(work: Work[Result]) -> Result:
    """Do the work, every update when it is due."""
    with closing(work):
        try:
            due = next(work)
            while True:
                due = work.send(due.learner.update(due.batch))
        except StopIteration as end:
            return end.value
