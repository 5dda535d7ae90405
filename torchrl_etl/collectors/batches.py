"""Batches of a collector, none of which is waited for without end."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector

__all__ = ["Batches", "CollectionError"]


class CollectionError(RuntimeError):
    """Workers failed, or something was waited for too long."""


class Batches:
    """What a learner needs of any TorchRL collector: the next batch, acted with fresh weights.

    Weights are pushed before each batch is asked for. With ``ahead`` the next batch is asked for
    as soon as one is delivered, so that it is collected while the learner learns; its policy is
    then one batch older, and everything is as reproducible as without.

    Workers start as this is made, and are waited for by :meth:`await_start` or whatever needs them
    first, so that several collectors can start at once. The start must draw no random numbers in
    this process, which goes on meanwhile.

    Args:
        make_collector (callable): builds the collector.

    Keyword Args:
        in_process (bool): whether it collects in this process, where nothing is waited for.
            Default: ``False``.
        ahead (bool): collect the next batch while the learner works on this one.
            Default: ``False``.
        restarts (bool): whether the collector can begin new episodes from a seed while it runs.
            Default: ``True``.
        timeout (float): most seconds to wait for anything: the start (from where it is waited for
            on), a batch, a push.
            Default: 120.

    Raises:
        CollectionError: from every method, if workers fail or a wait passes its limit.

    Examples:
        >>> from functools import partial
        >>> from torchrl_etl.collectors import Batches, VectorCollector
        >>> from torchrl_etl.envs import make_env
        >>> from torchrl_etl.modules import make_actor
        >>> env = make_env("overactuated", num_envs=2)
        >>> actor = make_actor({"observation": 6}, env.full_action_spec_unbatched["action"])
        >>> make = partial(VectorCollector, env, actor, frames_per_batch=8, total_frames=-1)
        >>> batches = Batches(make, in_process=True)
        >>> batches.restart(seed=0)
        >>> batches.next().shape
        torch.Size([2, 4])
        >>> batches.close()
    """

    def __init__(
        self,
        make_collector: Callable[[], BaseCollector],
        *,
        in_process: bool = False,
        ahead: bool = False,
        restarts: bool = True,
        timeout: float = 120.0,
    ) -> None:
        if in_process and ahead:
            raise ValueError(
                "ahead=True collects while the learner learns, which takes a second process; use "
                "another kind of collector."
            )
        self._caller = None if in_process else _Caller()
        self._ahead, self._restarts, self._timeout = ahead, restarts, timeout
        self._next: Future[TensorDictBase] | None = None
        self._is_stuck = False
        self._collector: BaseCollector | None = None
        if self._caller is not None:
            # With a team of OpenMP threads for the caller's operations there are more threads
            # than cores, and libgomp puts the learner's to sleep between any two operations.
            self._caller.call(torch.set_num_threads, 1)
        self._starting: Future[BaseCollector] | None = self._call(make_collector)
        if in_process:
            self.await_start()

    def await_start(self) -> None:
        """Wait until the workers are there."""
        if self._collector is None:
            with _threads_kept():
                self._collector = self._wait("start", self._starting)
            self._iterator = iter(self._collector)

    def restart(self, seed: int) -> None:
        """Begin new episodes that depend on the seed and the weights alone.

        A batch under way is dropped; it was never counted. A collector that cannot restart goes on.
        """
        self.await_start()
        if self._restarts:
            if self._next is not None:
                self._wait("give a batch", self._next)
                self._next = None
            self._do("take a seed", self._collector.set_seed, seed)
            if self._caller is None:  # workers have been reset by that already
                self._collector.reset()

    def ask(self) -> None:
        """Let workers begin with the next batch, if there are some and they have not."""
        if self._caller is not None and self._next is None:
            self._next = self._ask()

    def next(self) -> TensorDictBase:
        """The next batch, with the collector's batch size."""
        batch = self._wait("give a batch", self._next or self._ask())
        self._next = self._ask() if self._ahead else None
        return batch

    def close(self) -> None:
        """Stop the workers, by force if they do not listen; again does nothing."""
        if self._starting is None:
            return
        self._timeout = min(self._timeout, 30.0)
        if not self._is_stuck:
            with suppress(Exception):  # a failed start is told to who waits for it, if anybody does
                self.await_start()
        collector, self._collector, self._iterator, self._next = self._collector, None, None, None
        self._starting = None
        if self._is_stuck:  # the thread still waits for a worker; another one speaks to the rest
            _kill(collector)
            self._caller = _Caller()
        if collector is not None:  # it has started
            try:
                with _threads_kept():
                    self._do("stop", collector.shutdown)
            except CollectionError:
                _kill(collector)
        if self._caller is not None:
            self._caller.stop()

    def _ask(self) -> Future[TensorDictBase]:
        self.await_start()
        if self._caller is not None:
            self._do("take new weights", self._collector.update_policy_weights_)
        return self._call(next, self._iterator)

    def _do(self, what: str, function: Callable[..., Any], *args: Any) -> Any:
        return self._wait(what, self._call(function, *args))

    def _call(self, function: Callable[..., Any], *args: Any) -> Future:
        if self._caller is not None:
            return self._caller.call(function, *args)
        future: Future = Future()
        future.set_result(function(*args))
        return future

    def _wait(self, what: str, future: Future) -> Any:
        go_on = "The run can go on from its last checkpoint: resume=FOLDER."
        deadline = time.monotonic() + self._timeout
        while time.monotonic() < deadline:
            try:
                return future.result(min(1.0, self._timeout))
            except TimeoutError:
                # TorchRL 0.14.1 notices a dead worker when it waits for a batch, but not when it
                # waits for an answer.
                for index, process in enumerate(getattr(self._collector, "procs", ())):
                    if process.exitcode is not None:
                        self._is_stuck = True
                        raise CollectionError(
                            f"The collector's workers did not {what}: worker {index} ended (exit "
                            f"code {process.exitcode}). {go_on}"
                        ) from None
            except RuntimeError as error:
                if self._caller is None:
                    raise
                advice = "" if "resume=" in str(error) else go_on
                raise CollectionError(
                    f"The collector's workers did not {what}: {error} {advice}".strip()
                ) from error
        self._is_stuck = True
        raise CollectionError(
            f"The collector's workers did not {what} within {self._timeout:g} s; look for a "
            f"hanging simulator or network, or raise collector.timeout. {go_on}"
        )


@contextmanager
def _threads_kept() -> Iterator[None]:
    """PyTorch keeps as many threads: those of MKL, which a process has once, and this thread's."""
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _kill(collector: BaseCollector) -> None:
    for process in getattr(collector, "procs", ()):
        with suppress(ValueError):  # closed
            process.kill()


class _Caller:
    """Calls functions one after another, in a thread that the end of the process does not await."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[tuple[Future, Callable, tuple] | None] = queue.SimpleQueue()
        threading.Thread(target=self._run, daemon=True).start()

    def call(self, function: Callable[..., Any], *args: Any) -> Future:
        future: Future = Future()
        self._calls.put((future, function, args))
        return future

    def stop(self) -> None:
        self._calls.put(None)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            future, function, args = call
            try:
                future.set_result(function(*args))
            except BaseException as error:  # it is for the one who waits
                future.set_exception(error)
            del call, future, function, args
