"""Work that pauses where it would wait, so that runs can do so together."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import NamedTuple, TypeAlias, TypeVar

from tensordict import TensorDictBase

from torchrl_etl.learners import SACLearner

__all__ = ["Due", "Work", "alone"]

Result = TypeVar("Result")


class Due(NamedTuple):
    """Updates that a learner has earned, on these inputs [k], in the stage of this name."""

    stage: str
    learner: SACLearner
    inputs: TensorDictBase


# It yields what is due, is sent the scalars [k] of those updates, and returns what it is done for.
# Before it waits for a batch that others collect it yields None, and goes on when told to.
Work: TypeAlias = Generator[Due | None, TensorDictBase | None, Result]


def alone(work: Work[Result]) -> Result:
    """Do the work, all updates when they are due."""
    with closing(work):
        try:
            due = next(work)
            while True:
                due = work.send(None if due is None else due.learner.updates(due.inputs))
        except StopIteration as end:
            return end.value
