"""Collector workers in a torch.distributed process group: local processes or Slurm jobs."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from typing import Any, Literal
from unittest.mock import patch

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.collectors.distributed import DistributedCollector, generic
from torchrl.envs import EnvBase
from torchrl.weight_update import DistributedWeightSyncScheme

from torchrl_etl.checks import check_choice
from torchrl_etl.collectors.remote import (
    RemoteWorkers,
    check_arguments,
    cpu_copy,
    seeded_env,
    worker_options,
    worker_seed,
)
from torchrl_etl.collectors.worker_process import exit_with_learner

__all__ = ["DistributedWorkers"]


class DistributedWorkers(RemoteWorkers, DistributedCollector):
    """TorchRL's ``DistributedCollector`` with timeouts, serving the oldest ready request first.

    Workers and learner form one ``torch.distributed`` process group, which carries batches and
    weights. Its members are fixed, so a lost worker ends the run with a message that names it. On
    machines that come and go, use :class:`~torchrl_etl.collectors.ray.RayWorkers`.
    See :class:`~torchrl_etl.collectors.remote.RemoteWorkers` for the entries of a batch and the
    other arguments. ``create_env_fn`` is also called once in the learner's process, to determine
    the layout of a batch.

    Keyword Args:
        launcher (str): ``"mp"`` starts processes on this machine; ``"submitit"`` submits Slurm
            jobs, described by ``slurm_kwargs``. Defaults to ``"mp"``.
        tcp_port (int, optional): rendezvous port. Defaults to a free port.
        **kwargs: see :class:`~torchrl.collectors.distributed.DistributedCollector`, except
            for those that store or split batches or push weights.

    Raises:
        ImportError: if a launcher is not installed.

    Examples:
        >>> from torchrl_etl.collectors.distributed import DistributedWorkers
        >>> from torchrl_etl.envs import make_env
        >>> collector = DistributedWorkers(  # doctest: +SKIP
        ...     lambda: make_env("myoHandPose", num_envs=8),
        ...     TensorDictSequential(actor, decoder),
        ...     num_workers=2,
        ...     frames_per_batch=400,
        ... )
        >>> for batch in collector:  # doctest: +SKIP
        ...     learn(batch)
        ...     collector.update_policy_weights_()
    """

    def __init__(
        self,
        create_env_fn: Callable[[], EnvBase],
        policy: TensorDictModuleBase,
        *,
        num_workers: int,
        frames_per_batch: int,
        total_frames: int = -1,
        sync: bool = False,
        seed: int = 0,
        timeout: float = 300.0,
        launcher: Literal["mp", "submitit"] = "mp",
        tcp_port: int | None = None,
        collector_class: type[Collector] = Collector,
        collector_kwargs: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        check_arguments(create_env_fn, policy, num_workers, frames_per_batch, sync, timeout, kwargs)
        collector_kwargs = worker_options(collector_class, collector_kwargs)
        _check_launcher(launcher)
        share = frames_per_batch // num_workers if sync else frames_per_batch
        work = {"frames_per_batch": share, "collector_class": collector_class}
        own_policy = cpu_copy(policy)
        # TorchRL's constructor calls _make_container, which copies this.
        self._example = _one_batch(create_env_fn, own_policy, **work, **collector_kwargs)
        with self._starting(seed, timeout):
            super().__init__(
                [create_env_fn] * num_workers,
                own_policy,
                **work,
                sync=False,  # TorchRL's only protocol whose replies can be polled
                launcher=launcher,
                tcp_port=tcp_port or _free_port(),
                collector_kwargs=collector_kwargs,
                weight_sync_schemes={"policy": DistributedWeightSyncScheme()},
                **kwargs,
            )
        self.policy, self.frames_per_batch = policy, frames_per_batch
        self._prepare(policy, sync, total_frames, timeout)
        self._trackers, self._asked = {}, {}
        self._known = dict.fromkeys(range(num_workers), 0)  # TorchRL has already sent the weights

    # Workers ---------------------------------------------------------------------------------

    @contextmanager
    def _starting(self, seed: int, timeout: float) -> Iterator[None]:
        """Around TorchRL's constructor: seed workers, set timeouts, shut down after a failure."""
        # TorchRL 0.14.1 reads its timeout for the process group, 1000, as days. Its set_seed ends
        # the workers, so their main function has to seed them.
        days, main = timeout / 86_400, partial(_seeded_main, seed)
        mended = {"MAX_TIME_TO_CONNECT": days, "_distributed_init_collection_node": main}
        self.jobs, self._weight_sync_schemes = [], None
        try:
            with patch.multiple(generic, **mended):
                yield
        except BaseException as error:
            dead = self._dead()
            self.shutdown()
            if not isinstance(error, Exception):
                raise
            who = f"worker {dead[0]} ended while it started" if dead else "workers did not start"
            raise RuntimeError(
                f"DistributedWorkers: {who} (limit {timeout:g} s; its own message is in its "
                f"output). {error}"
            ) from error
        for store in (self._store, self._weight_sync_schemes["policy"]._store):
            store.set_timeout(timedelta(seconds=timeout))  # workers' stores wait longer

    def _make_container(self) -> None:
        self._tensordict_out = [self._example.clone().lock_() for _ in range(self.num_workers)]

    def _dead(self) -> list[int]:
        """Workers whose process or job has ended."""
        ended = [not job.is_alive() if self.launcher == "mp" else job.done() for job in self.jobs]
        return [worker for worker, has in enumerate(ended) if has]

    # Batches ---------------------------------------------------------------------------------

    def _request(self, worker: int) -> None:
        rank = worker + 1
        try:
            if self._needs_weights(worker):
                # The worker is idle, so weights never change within a batch.
                self._weight_sync_schemes["policy"].send(self._weights, worker_ids=worker)
            # TorchRL 0.14.1 leaves setting "busy" to the worker. Until it does, the "done" of its
            # last batch counts for the next one, and the learner blocks on that batch.
            self._store.set(f"NODE_{rank}_status", b"busy")
            self._store.set(f"NODE_{rank}_in", b"continue")
            out = self._tensordict_out[worker]
            self._trackers[worker] = out.irecv(src=rank, return_premature=True)
            self._asked[worker] = time.monotonic()
        except RuntimeError as error:
            raise self._lost(worker, f"did not receive weights ({error})") from error

    def _requested(self) -> Collection[int]:
        return self._trackers

    def _receive(self) -> tuple[int, TensorDictBase]:
        worker = self._wait()
        try:
            for tracker in self._trackers.pop(worker):
                tracker.wait()
        except RuntimeError as error:
            raise self._lost(worker, f"was lost while it sent a batch ({error})") from error
        return worker, self._with_origin(self._tensordict_out[worker].clone(), worker)

    def _wait(self) -> int:
        """The worker whose request is oldest among those that have a batch."""
        pause = 0.001
        while True:
            asked = list(self._trackers)
            states = self._store.multi_get([f"NODE_{worker + 1}_status" for worker in asked])
            busy = [worker for worker, state in zip(asked, states, strict=True) if state == b"busy"]
            for worker in set(busy) & set(self._dead()):
                raise self._lost(worker, "has ended")
            for worker in busy:
                if time.monotonic() - self._asked[worker] > self.timeout:
                    raise self._lost(worker, f"sent no batch within {self.timeout:g} s")
            if len(busy) < len(asked):
                return next(worker for worker in asked if worker not in busy)
            time.sleep(pause)
            pause = min(2 * pause, 0.02)

    def shutdown(self, timeout: float | None = None) -> None:
        """Ask the workers to end, and kill them after ``timeout`` (default 5 s). Idempotent."""
        if getattr(self, "_shutdown", False):
            return
        self._shutdown = self._stopped = True
        # TorchRL's shutdown waits for a reply of every worker and raises if one is dead. It also
        # leaves the threads that wait for weights running, which delays each worker by 5 s.
        limit = time.monotonic() + (5.0 if timeout is None else timeout)
        with suppress(RuntimeError, AttributeError):  # the constructor may have failed before
            self._store.set("TRAINER_status", b"shutdown")
            for worker in range(self.num_workers):
                self._weight_sync_schemes["policy"]._store.set(f"NODE_{worker + 1}_in", b"stop")
                self._store.set(f"NODE_{worker + 1}_in", b"shutdown")
        while len(self._dead()) < len(self.jobs) and time.monotonic() < limit:
            time.sleep(0.01)
        for job in self.jobs:
            if self.launcher == "mp":
                job.kill()
                job.join(1.0)
            else:
                job.cancel()
        for scheme in (self._weight_sync_schemes or {}).values():
            scheme.shutdown()
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        else:  # torch 2.13 counts groups that failed to start; new workers start from 0
            torch.distributed.distributed_c10d._world.group_count = 0


_main = generic._distributed_init_collection_node


def _seeded_main(seed: int, **kwargs: Any) -> None:
    """TorchRL's main function of a worker, with a seeded environment."""
    exit_with_learner()
    kwargs["env_make"] = seeded_env(kwargs["env_make"], worker_seed(seed, kwargs["rank"] - 1))
    _main(**kwargs)


def _check_launcher(launcher: str) -> None:
    check_choice("launcher", launcher, ("mp", "submitit"))
    if launcher == "submitit" and not generic._has_submitit:
        raise ImportError("launcher='submitit' needs submitit: pip install 'torchrl_etl[slurm]'.")
    if torch.distributed.is_initialized():
        raise RuntimeError(
            "DistributedWorkers needs torch's default process group, and this process already has "
            "one. Use RayWorkers, or call destroy_process_group() first."
        )


def _one_batch(
    create_env_fn: Callable[[], EnvBase],
    policy: TensorDictModuleBase,
    *,
    collector_class: type[Collector],
    **kwargs: Any,
) -> TensorDictBase:
    """An example batch of a worker.

    TorchRL 0.14.1 collects its example after starting the workers, and with the base class
    Collector, whose batches may have other entries than those of ``collector_class``.
    """
    with torch.random.fork_rng(devices=[]):
        collector = collector_class(
            create_env_fn, policy, total_frames=-1, return_same_td=True, **kwargs
        )
        try:
            return next(iter(collector)).clone()
        finally:
            collector.shutdown()


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("", 0))
        return listener.getsockname()[1]
