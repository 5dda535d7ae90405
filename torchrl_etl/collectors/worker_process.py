"""How a worker process behaves: it lives as long as its learner, and no longer."""

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
    "live_as_long_as_the_learner",
    "start_resource_tracker",
    "stop_signals_blocked",
]

# What asks a run to save and leave: Ctrl-C, kill and Slurm, Slurm's --signal, a closed terminal.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)


def live_as_long_as_the_learner() -> None:
    """In a worker: leave signals to the learner, and end when it has ended, however it did.

    A terminal and a batch system send their signals to every process of a run. The learner needs
    its workers until it has saved; it then stops them by itself.
    """
    learner = multiprocessing.parent_process()
    if learner is None:  # a job of its own, which nobody but the signal would end
        return
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(learner.sentinel,), daemon=True).start()


@contextmanager
def stop_signals_blocked() -> Iterator[None]:
    """Let processes that are started here begin life deaf to stop signals.

    Those that come meanwhile are not lost: they reach the learner through its other threads, or
    at the end of the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_resource_tracker() -> None:
    """Start Python's resource tracker, which the first lock would start, deaf to stop signals.

    By itself it is deaf to Ctrl-C and SIGTERM alone; another signal to all processes of a run would
    end it, and each lock that it knew of is then a traceback when the run ends.
    """
    with stop_signals_blocked():
        resource_tracker.ensure_running()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)
