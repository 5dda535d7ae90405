"""Collector batches, with a timeout on every wait."""

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
    """Workers failed, or a wait timed out."""


class Batches:
    """Batches of any TorchRL collector, each collected with the current policy weights.

    Weights are pushed before each batch is requested. With ``ahead``, the next batch is requested
    as soon as one is delivered and is collected while the learner updates. Its policy is then one
    batch older; runs are as reproducible as without ``ahead``.

    The constructor starts the workers without waiting, so several collectors can start at once.
    :meth:`await_start`, or the first method that needs the workers, waits for them. Starting must
    draw no random numbers in this process, which continues meanwhile.

    Args:
        make_collector (callable): builds the collector.

    Keyword Args:
        in_process (bool): whether the collector runs in this process, without timeouts.
            Default: ``False``.
        ahead (bool): collect the next batch while the learner works on this one.
            Default: ``False``.
        restarts (bool): whether a running collector can begin new episodes from a seed.
            Default: ``True``.
        timeout (float): longest wait in seconds for the start (counted from the first wait),
            a batch, or a push of weights.
            Default: 120.

    Raises:
        CollectionError: from every method, if workers fail or a wait times out.

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
                "ahead=True collects while the learner learns and so needs another process; use a "
                "collector that has one."
            )
        self._caller = None if in_process else _Caller()
        self._ahead, self._restarts, self._timeout = ahead, restarts, timeout
        self._next: Future[TensorDictBase] | None = None
        self._is_stuck = False
        self._collector: BaseCollector | None = None
        if self._caller is not None:
            # A second team of OpenMP threads would exceed the cores; libgomp then puts the
            # learner's threads to sleep between operations.
            self._caller.call(torch.set_num_threads, 1)
        self._starting: Future[BaseCollector] | None = self._call(make_collector)
        if in_process:
            self.await_start()

    def await_start(self) -> None:
        """Wait until the workers have started."""
        if self._collector is None:
            with _threads_kept():
                self._collector = self._wait("start", self._starting)
            self._iterator = iter(self._collector)

    def restart(self, seed: int) -> None:
        """Begin new episodes that depend only on the seed and the weights.

        Drops a pending batch, whose frames were never counted. No effect without ``restarts``.
        """
        self.await_start()
        if self._restarts:
            if self._next is not None:
                self._wait("return a batch", self._next)
                self._next = None
            self._do("accept a seed", self._collector.set_seed, seed)
            if self._caller is None:  # set_seed has already reset workers
                self._collector.reset()

    def request(self) -> None:
        """Request the next batch from the workers, if there are any and none is pending."""
        if self._caller is not None and self._next is None:
            self._next = self._request()

    def next(self) -> TensorDictBase:
        """The next batch, with the collector's batch size."""
        batch = self._wait("return a batch", self._next or self._request())
        self._next = self._request() if self._ahead else None
        return batch

    def close(self) -> None:
        """Stop the workers, and kill those that do not respond. Idempotent."""
        if self._starting is None:
            return
        self._timeout = min(self._timeout, 30.0)
        if not self._is_stuck:
            with suppress(Exception):  # await_start reports a failed start to its own callers
                self.await_start()
        collector, self._collector, self._iterator, self._next = self._collector, None, None, None
        self._starting = None
        if self._is_stuck:  # its thread still waits for a worker: stop the others from a new one
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

    def _request(self) -> Future[TensorDictBase]:
        self.await_start()
        if self._caller is not None:
            self._do("accept new weights", self._collector.update_policy_weights_)
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
        go_on = "Continue from the last checkpoint with resume=FOLDER."
        deadline = time.monotonic() + self._timeout
        while time.monotonic() < deadline:
            try:
                return future.result(min(1.0, self._timeout))
            except (RuntimeError, TimeoutError) as error:
                if future.done() and future.exception() is error:
                    advice = "" if "resume=" in str(error) else go_on
                    raise CollectionError(
                        f"The collector's workers did not {what}: {error} {advice}".strip()
                    ) from error
            # TorchRL 0.14.1 detects a dead worker while it waits for a batch, but not while it
            # waits for a reply.
            for index, process in enumerate(getattr(self._collector, "procs", ())):
                if process.exitcode is not None:
                    self._is_stuck = True
                    raise CollectionError(
                        f"The collector's workers did not {what}: worker {index} ended (exit code "
                        f"{process.exitcode}). {go_on}"
                    )
        self._is_stuck = True
        raise CollectionError(
            f"The collector's workers did not {what} within {self._timeout:g} s; look for a "
            f"hanging simulator or network, or raise collector.timeout. {go_on}"
        )


@contextmanager
def _threads_kept() -> Iterator[None]:
    """Restore PyTorch's thread counts: MKL's, which is global, and this thread's."""
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
    """Runs calls in order in a daemon thread."""

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
            except BaseException as error:  # re-raised where the result is awaited
                future.set_exception(error)
            del call, future, function, args
