"""Worker processes that live exactly as long as their learner."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import wait

__all__ = [
    "STOP_SIGNALS",
    "exit_with_learner",
    "start_resource_tracker",
    "stop_signals_blocked",
]

# Signals on which a run saves and exits: Ctrl-C, kill and Slurm, Slurm's --signal, a hangup.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)


def exit_with_learner() -> None:
    """Call it in a worker: ignore stop signals, and exit when the learner's process has ended.

    Terminals and batch systems signal every process of a run. The learner needs its workers until
    it has saved, and then stops them itself.
    """
    learner = multiprocessing.parent_process()
    if learner is None:  # a separate job, which only the signal would end
        return
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(learner.sentinel,), daemon=True).start()


@contextmanager
def stop_signals_blocked() -> Iterator[None]:
    """Processes started in this block inherit a mask that blocks stop signals.

    No signal is lost: the learner receives it in another thread, or at the end of the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_resource_tracker() -> None:
    """Start Python's resource tracker, before the first lock does, with stop signals blocked.

    The tracker itself ignores only Ctrl-C and SIGTERM. Another signal to all processes of a run
    would end it, and the run would then end with a traceback for each lock.
    """
    with stop_signals_blocked():
        resource_tracker.ensure_running()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
