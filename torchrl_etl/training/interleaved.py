"""Several seeds of a run in one process, to make use of a GPU."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Generic

from tensordict import TensorDictBase
from torchrl.checkpoint import GlobalRNGState

from torchrl_etl.learners import SACLearner, StackedLearners
from torchrl_etl.training.loop import Interrupted
from torchrl_etl.training.work import PendingUpdates, Result, Work, run_alone

__all__ = ["run_interleaved"]


def run_interleaved(works: Sequence[Work[Result]]) -> list[Result | BaseException]:
    """Interleave several works, and run updates that are due at the same time in one pass.

    Each work requests a batch from its simulators before any of them waits for one. A work that is
    ahead of others in its stage, as after a resume, waits for them. Each has its own RNG state, so
    its results equal those of :func:`~torchrl_etl.training.work.run_alone` up to rounding. If one
    fails or is stopped, the others continue.

    Args:
        works (sequence of generator): runs or stages, as for
            :func:`~torchrl_etl.training.work.run_alone`.

    Returns:
        list: the return value of each work, or the exception that ended it.
    """
    if len(works) == 1:
        try:
            return [run_alone(works[0])]
        except (Exception, Interrupted) as error:
            return [error]
    runs = [_Run(work) for work in works]
    groups: dict[tuple[SACLearner, ...], StackedLearners] = {}
    try:
        while waiting := _those_with_updates_due(runs):
            learners = {run.due.learner for run in waiting}
            for done in [group for group in groups if learners.isdisjoint(group)]:
                del groups[done]  # frees its copy of all their weights
            alike = defaultdict(list)
            for run in _behind(waiting):
                alike[run.alike].append(run)
            for each in alike.values():
                try:
                    found = _updated(each, groups)
                except Exception as fault:  # out of GPU memory, for example
                    for run in each:
                        run.go_on(None, fault)
                else:
                    for run, scalars in zip(each, found, strict=True):
                        run.go_on(scalars)
    finally:
        for run in runs:
            run.work.close()
    return [run.result for run in runs]


class _Run(Generic[Result]):
    """A work, its due updates, and its RNG state."""

    def __init__(self, work: Work[Result]) -> None:
        self.work, self.random = work, GlobalRNGState().state_dict()
        self.due: PendingUpdates | None = None
        self.ended = False
        self.result: Result | BaseException

    @property
    def alike(self) -> tuple[Any, ...]:
        """Key that is equal for runs that can be updated together."""
        learner, shape = self.due.learner, self.due.inputs["batch"].shape
        return self.due.stage, shape, learner.step_sizes, learner.blueprint

    def __enter__(self) -> None:
        GlobalRNGState().load_state_dict(self.random)

    def __exit__(self, *error: Any) -> None:
        self.random = GlobalRNGState().state_dict()

    def go_on(self, scalars: TensorDictBase | None, fault: Exception | None = None) -> None:
        with self:
            try:
                self.due = self.work.send(scalars) if fault is None else self.work.throw(fault)
            except StopIteration as end:
                self.due, self.ended, self.result = None, True, end.value
            except (Exception, Interrupted) as error:
                self.due, self.ended, self.result = None, True, error


def _those_with_updates_due(runs: Sequence[_Run]) -> list[_Run]:
    """Advance all runs to their next updates; returns those that have not ended."""
    while on := [run for run in runs if run.due is None and not run.ended]:
        for run in on:
            run.go_on(None)
    return [run for run in runs if not run.ended]


def _behind(runs: Sequence[_Run]) -> list[_Run]:
    """The runs with the fewest updates in their stage."""
    fewest: dict[str, int] = {}
    updates = [run.due.learner.num_updates for run in runs]
    for run, own in zip(runs, updates, strict=True):
        fewest[run.due.stage] = min(own, fewest.get(run.due.stage, own))
    return [run for run, own in zip(runs, updates, strict=True) if own == fewest[run.due.stage]]


def _updated(
    runs: Sequence[_Run], groups: dict[tuple[SACLearner, ...], StackedLearners]
) -> list[TensorDictBase]:
    """Run the due updates of these runs, all in the same stage; returns their scalars."""
    learners = tuple(run.due.learner for run in runs)
    if len(runs) == 1:
        with runs[0]:
            return [learners[0].updates(runs[0].due.inputs)]
    group = groups.get(learners)
    if group is None:
        group = groups[learners] = StackedLearners(learners)
    return group.updates([run.due.inputs for run in runs])
