"""Several runs that differ in their seeds, in one process."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any, Generic

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.checkpoint import GlobalRNGState

from torchrl_etl.learners import SideBySide
from torchrl_etl.learners.compiled import IN_PYTHON
from torchrl_etl.training.loop import Interrupted
from torchrl_etl.training.work import Due, Result, Work, alone

__all__ = ["together"]


def together(
    works: Sequence[Work[Result]], *, joint: bool | None = None
) -> list[Result | BaseException]:
    """Do all works in turns, and updates that are due at the same time together.

    Each work finds the random generators as it left them, and its updates get the random numbers
    that it would have drawn for them by itself: it ends with the numbers of
    :func:`~torchrl_etl.training.work.alone`, up to rounding. One that fails, or is stopped, leaves
    the others to go on.

    Args:
        works (sequence of generator): runs or stages, as :func:`~torchrl_etl.training.work.alone`
            takes one.

    Keyword Args:
        joint (bool, optional): one pass through the networks of all, rather than a thread for
            each. Default: unless updates are compiled for a CPU.

    Returns:
        list: what each work returned, or the exception that ended it.
    """
    if len(works) == 1:
        try:
            return [alone(works[0])]
        except (Exception, Interrupted) as error:
            return [error]
    runs = [_Run(work) for work in works]
    groups: dict[str, SideBySide] = {}
    try:
        for run in runs:
            run.go_on(None)
        while waiting := [run for run in runs if run.due is not None]:
            if apart := [run for run in waiting if run.is_apart(joint)]:
                _in_threads(apart, joint)
            for alike in dict.fromkeys(run.alike for run in waiting if run not in apart):
                _as_one([run for run in waiting if run.alike == alike], groups)
    finally:
        for run in runs:
            run.work.close()
    return [run.result for run in runs]


class _Run(Generic[Result]):
    """A work, what it waits for, and its own state of the random generators."""

    def __init__(self, work: Work[Result]) -> None:
        self.work, self.random = work, GlobalRNGState().state_dict()
        self.due: Due | None = None
        self.result: Result | BaseException

    @property
    def alike(self) -> tuple[str, int]:
        """What is due to runs that can be updated together: the stage, and how many updates."""
        return self.due.stage, len(self.due.batches)

    def is_apart(self, joint: bool | None) -> bool:
        """Whether what is due is for a thread of its own."""
        learner = self.due.learner
        return not joint if joint is not None else learner.compile and learner.device.type == "cpu"

    def __enter__(self) -> None:
        GlobalRNGState().load_state_dict(self.random)

    def __exit__(self, *error: Any) -> None:
        self.random = GlobalRNGState().state_dict()

    def draw(self) -> list[list[Tensor]]:
        """The random numbers of what is due, update by update."""
        with self:
            return [self.due.learner.draw(batch) for batch in self.due.batches]

    def go_on(self, scalars: TensorDictBase | None) -> None:
        with self:
            try:
                self.due = self.work.send(scalars)
            except StopIteration as end:
                self.due, self.result = None, end.value
            except (Exception, Interrupted) as error:
                self.due, self.result = None, error


def _as_one(runs: Sequence[_Run], groups: dict[str, SideBySide]) -> None:
    """What is due to these runs, which are in the same stage, is one pass through all networks."""
    learners = [run.due.learner for run in runs]
    if len(runs) == 1:
        with runs[0]:
            scalars = learners[0].updates(runs[0].due.batches)
        return runs[0].go_on(scalars)
    group = groups.get(stage := runs[0].due.stage)
    if group is None or group.learners != learners:
        group = groups[stage] = SideBySide(learners)
    scalars = group.updates([run.due.batches for run in runs], [run.draw() for run in runs])
    for run, own in zip(runs, scalars, strict=True):
        run.go_on(own)


def _in_threads(waiting: Sequence[_Run], joint: bool | None) -> None:
    """Each run is updated in a thread of its own, while this one goes on with others in turn.

    PyTorch's operations run beside each other; what Python does between them takes turns. It ends
    when all runs have ended, or have come to a stage where they are updated as one.
    """
    threads = torch.get_num_threads()
    share = max(1, threads // len(waiting))
    pending: dict[Future[TensorDictBase], _Run] = {}
    with ThreadPoolExecutor(
        len(waiting), initializer=torch.set_num_threads, initargs=(share,)
    ) as pool:
        while waiting or pending:
            for run in waiting:
                with IN_PYTHON:
                    draws = run.draw()
                pending[pool.submit(run.due.learner.updates, run.due.batches, draws)] = run
            done = wait(pending, return_when=FIRST_COMPLETED).done
            ended = [(pending.pop(future), future.result()) for future in done]
            for run, scalars in ended:
                with IN_PYTHON:
                    run.go_on(scalars)
            waiting = [run for run, _ in ended if run.due is not None and run.is_apart(joint)]
    torch.set_num_threads(threads)  # of MKL, which has one number for all threads
