"""Work that yields where it would wait, so that several runs can be interleaved."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import NamedTuple, TypeAlias, TypeVar

from tensordict import TensorDictBase

from torchrl_etl.learners import SACLearner

__all__ = ["PendingUpdates", "Work", "run_alone"]

Result = TypeVar("Result")


class PendingUpdates(NamedTuple):
    """Updates that are due for a learner, with their inputs [k] and the name of the stage."""

    stage: str
    learner: SACLearner
    inputs: TensorDictBase


# Yields due updates, receives their scalars [k], and returns its result. It also yields None before
# it waits for a batch from other processes.
Work: TypeAlias = Generator[PendingUpdates | None, TensorDictBase | None, Result]


def run_alone(work: Work[Result]) -> Result:
    """Run the work by itself, with each update as it becomes due."""
    with closing(work):
        try:
            due = next(work)
            while True:
                due = work.send(None if due is None else due.learner.updates(due.inputs))
        except StopIteration as end:
            return end.value
