"""Several runs in parallel, each in its own process."""

from __future__ import annotations

import os
import pickle
import shlex
import signal
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.layout import available_cores
from torchrl_etl.training import Interrupted, run_alone
from torchrl_etl.training.config import resume_setting
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.sweep import end_with_parent

__all__ = ["in_processes"]

Ended = tuple[Path, dict[str, Any] | BaseException]


def in_processes(runs: Sequence[Mapping[str, Any]]) -> list[Ended]:
    """Do all runs in parallel; the others continue if one fails, is stopped or is killed.

    This is the fastest way on a CPU: within one process, Python code, simulators included, would
    run serially. Cores are divided among the runs. A stop signal is forwarded once.

    Args:
        runs (sequence of mapping): picklable arguments of
            :class:`~torchrl_etl.experiment.Experiment`, with ``config`` and ``resume``.

    Returns:
        list: for each run its folder, and the return value of
        :meth:`~torchrl_etl.experiment.Experiment.run` or the exception that ended it.
    """
    context, threads = get_context("spawn"), max(1, available_cores() // len(runs))
    working, ends = {}, {}
    with StopOnSignal() as stop:
        # This process forwards Ctrl-C as SIGTERM. Children ignore SIGINT, and block SIGTERM until
        # they can save.
        on_interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
        for index, run in enumerate(runs):
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_run, args=(sender, run, threads))
            process.start()
            sender.close()
            working[receiver] = index, process
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
        signal.signal(signal.SIGINT, on_interrupt)
        told = False
        while working:
            for receiver in wait(list(working), timeout=0.5):
                index, process = working.pop(receiver)
                ends[index] = _end(receiver, runs[index], process)
            if stop.requested and not told:
                told = True
                for _, process in working.values():
                    process.terminate()
    return [ends[index] for index in range(len(runs))]


def _run(sender: Connection, run: Mapping[str, Any], threads: int) -> None:
    """Main function of a run's process."""
    os.setsid()
    quiet_torchrl()
    torch.set_num_threads(threads)
    with StopOnSignal() as stop:
        end_with_parent()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
        experiment = Experiment(**run)
        try:
            end = run_alone(experiment.work(stop))
        except (Exception, Interrupted) as error:
            end = _sendable(error)
            end.add_note(traceback.format_exc())
    with suppress(BrokenPipeError):  # the parent was killed
        sender.send((experiment.folder.path, end))


def _sendable(error: BaseException) -> BaseException:
    """The error, or its words where another process could not make it again."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # an environment's own class with arguments of its own, say
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _end(receiver: Connection, run: Mapping[str, Any], process: Any) -> Ended:
    try:
        return receiver.recv()
    except EOFError:  # the process was killed
        process.join()
        folder = Path(run["resume"] or run["config"].run_dir)
        setting = shlex.quote(resume_setting([folder]))
        return folder, ChildProcessError(
            f"The process of {folder} ended with exit code {process.exitcode}; continue with "
            f"{setting}."
        )
