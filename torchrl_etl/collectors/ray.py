"""Collector workers on the machines of a Ray cluster."""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.collectors.distributed import RayCollector
from torchrl.collectors.weight_update import RemoteModuleWeightUpdater
from torchrl.envs import EnvBase

from torchrl_etl.checks import check_integer
from torchrl_etl.collectors.remote import (
    RemoteWorkers,
    check_arguments,
    cpu_copy,
    seeded_env,
    worker_options,
    worker_seed,
)

__all__ = ["RayWorkers"]


class RayWorkers(RemoteWorkers, RayCollector):
    """TorchRL's :class:`~torchrl.collectors.distributed.RayCollector` that replaces lost workers.

    Each worker is a Ray actor that runs ``collector_class`` on one (batched) environment. Weights
    are sent through Ray's object store, in order with the requests for batches. Every wait has a
    timeout. A worker that is lost or late is replaced, up to ``replacements`` times in all, by one
    with the newest weights and a seed of its own. The pending batch of a lost worker is never
    delivered, so no frame is counted twice.
    See :class:`~torchrl_etl.collectors.remote.RemoteWorkers` for the entries of a batch and the
    other arguments. A replacement has to start and collect a batch within ``timeout``.

    Keyword Args:
        replacements (int): lost workers to replace before giving up. Defaults to 3.
        address (str, optional): Ray cluster to join: ``"auto"``, ``"host:port"`` or
            ``"ray://host:port"``. By default a local cluster is started, and stopped by
            :meth:`shutdown`. If Ray is already initialized in this process, it is used.
        ray_init_config (mapping, optional): further arguments of ``ray.init``.
        remote_configs (mapping, optional): resources and placement of a worker, as in
            ``ray.remote``. Defaults to ``{"num_cpus": 1}``; a worker gets as many OpenMP threads
            as CPUs.
        **kwargs: see :class:`~torchrl.collectors.distributed.RayCollector`, except
            for those that store or split batches or push weights.

    Raises:
        ImportError: if Ray is not installed.

    Examples:
        >>> from torchrl_etl.collectors.ray import RayWorkers
        >>> from torchrl_etl.envs import make_env
        >>> collector = RayWorkers(  # doctest: +SKIP
        ...     lambda: make_env("myoHandPose", num_envs=8),
        ...     TensorDictSequential(actor, decoder),
        ...     num_workers=2,
        ...     frames_per_batch=400,
        ...     address="auto",
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
        replacements: int = 3,
        address: str | None = None,
        collector_class: type[Collector] = Collector,
        collector_kwargs: Mapping[str, Any] | None = None,
        ray_init_config: Mapping[str, Any] | None = None,
        remote_configs: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        check_arguments(create_env_fn, policy, num_workers, frames_per_batch, sync, timeout, kwargs)
        collector_kwargs = worker_options(collector_class, collector_kwargs)
        check_integer(0, replacements=replacements)
        remote_configs = {"num_cpus": 1, **(remote_configs or {})}
        # TorchRL's constructor calls add_collectors, which starts workers with these, and shutdown
        # if that fails.
        self.create_env_fn, self.seed, self.started = create_env_fn, seed, 0
        self._prepare(policy, sync, total_frames, timeout)
        self._pending: dict[Any, tuple[int, Any, float]] = {}
        cluster = _cluster(address, cpus=int(num_workers * remote_configs["num_cpus"]))
        with self._starting():
            super().__init__(
                create_env_fn,
                policy,
                num_collectors=num_workers,
                frames_per_batch=frames_per_batch,
                total_frames=self.total_frames,
                sync=sync,
                collector_class=_seeded(collector_class),
                collector_kwargs=collector_kwargs,
                ray_init_config={**cluster, **(ray_init_config or {})},
                remote_configs=remote_configs,
                # TorchRL 0.14.1's weight-sync scheme joins all workers in a process group, which a
                # replacement cannot enter. It also waits for pending batches and fails after 60 s.
                weight_updater=RemoteModuleWeightUpdater(),
                **kwargs,
            )
        self.replacements = replacements

    # Workers ---------------------------------------------------------------------------------

    @contextmanager
    def _starting(self) -> Iterator[None]:
        """Around TorchRL's constructor: wait for the workers, shut down after a failure."""
        try:
            yield
            self._await_start()
        except BaseException:
            if hasattr(self, "_runtime_lease"):
                self.shutdown()
            raise

    def add_collectors(
        self, create_env_fn, num_envs, policy, collector_kwargs, remote_configs
    ) -> None:
        """Starts the workers; called once, by TorchRL's constructor."""
        self._recipe = collector_kwargs, remote_configs
        self._remote_collectors.extend(self._start(worker) for worker in range(len(create_env_fn)))

    def _start(self, worker: int) -> Any:
        """A new actor with the newest weights and an unused seed."""
        kwargs, config = (of_workers[worker] for of_workers in self._recipe)
        seed = worker_seed(self.seed, self.started)
        self.started += 1
        self._known[worker] = self.policy_version
        policy = cpu_copy(self.policy)
        self._weights.to_module(policy)
        return self.collector_class.as_remote(config).remote(
            self.create_env_fn, policy, seed, total_frames=-1, **{**kwargs, "worker_idx": worker}
        )

    def _await_start(self) -> None:
        import ray

        ready = [worker.__ray_ready__.remote() for worker in self._remote_collectors]
        done, late = ray.wait(ready, num_returns=len(ready), timeout=self.timeout)
        for worker, future in enumerate(ready):
            if future in done:
                try:
                    self._get(future, worker)
                except ray.exceptions.RayError as error:
                    raise self._lost(worker, f"could not be started: {error}") from error
        if late:
            raise RuntimeError(
                f"RayWorkers: {len(late)} of {len(ready)} workers did not start in "
                f"{self.timeout:g} s. Each needs {self._recipe[1][0]}; the cluster has "
                f"{ray.available_resources()} free. Use fewer or smaller workers, add nodes, or "
                "raise timeout."
            )

    def _get(self, future: Any, worker: int) -> Any:
        """The value of a future that is ready."""
        import ray

        try:
            return ray.get(future, timeout=self.timeout)
        except ray.exceptions.RayTaskError as error:  # a replacement would fail likewise
            raise self._lost(worker, f"failed: {error}") from error

    # Batches ---------------------------------------------------------------------------------

    def _request(self, worker: int) -> None:
        import ray

        actor, push = self._remote_collectors[worker], None
        if self._needs_weights(worker):
            # One copy in the object store serves all workers.
            if getattr(self, "_stored", (None,))[0] is not self._weights:
                self._stored = self._weights, ray.put(self._weights)
            push = actor.update_policy_weights_.remote(self._stored[1])
        self._pending[actor.next.remote()] = worker, push, time.monotonic()

    def _requested(self) -> Collection[int]:
        return {worker for worker, *_ in self._pending.values()}

    def _receive(self) -> tuple[int, TensorDictBase]:
        import ray

        while True:
            oldest = min(asked for _, _, asked in self._pending.values())
            left = oldest + self.timeout - time.monotonic()
            if left <= 0:
                self._replace_the_late()
                left = 1.0
            done, _ = ray.wait(list(self._pending), num_returns=1, timeout=left)
            if not done:
                continue
            worker, push, _ = self._pending.pop(done[0])
            try:
                if push is not None:
                    self._get(push, worker)
                batch = self._get(done[0], worker)
            except ray.exceptions.RayError as error:  # the actor, its node or the object is gone
                self._replace(worker, f"was lost ({type(error).__name__})", error)
                continue
            return worker, self._with_origin(batch, worker)

    def _replace_the_late(self) -> None:
        import ray

        _, busy = ray.wait(list(self._pending), num_returns=len(self._pending), timeout=0)
        for future in busy:
            if time.monotonic() - self._pending[future][2] >= self.timeout:
                worker = self._pending.pop(future)[0]
                self._replace(worker, f"sent no batch within {self.timeout:g} s")

    def _replace(self, worker: int, cause: str, error: Exception | None = None) -> None:
        import ray

        ray.kill(self._remote_collectors[worker])
        lost = self.started - self.num_workers
        if lost >= self.replacements:
            raise self._lost(worker, f"{cause}; {lost} were already replaced") from error
        self._remote_collectors[worker] = self._start(worker)
        self._request(worker)

    def shutdown(self, timeout: float | None = None, shutdown_ray: bool = False) -> None:
        """Stop the workers, and Ray if it was started for them. Idempotent."""
        self._stopped = True
        self._pending.clear()
        super().shutdown(timeout, shutdown_ray)


def _cluster(address: str | None, cpus: int) -> dict[str, Any]:
    """Arguments of ``ray.init`` that join a cluster, or start one on this machine."""
    if importlib.util.find_spec("ray") is None:
        raise ImportError("RayWorkers needs Ray: pip install 'torchrl_etl[ray]'.")
    config = {"address": address or "local", "log_to_driver": False, "logging_level": "error"}
    if address is None:  # the caller decides how many workers fit this machine
        config |= {"num_cpus": max(cpus + 1, os.cpu_count() or 1), "include_dashboard": False}
    return config


def _seeded(collector_class: type[Collector]) -> type[Collector]:
    """A subclass that first seeds its worker process. Ray sends it by value."""

    class Seeded(collector_class):
        def __init__(self, create_env_fn, policy, seed, **kwargs):
            super().__init__(seeded_env(create_env_fn, seed), policy, **kwargs)

        # Ray calls bool() on an actor to report an exception. TorchRL 0.14.1 falls back on len(),
        # which is infinite: the worker would die, and the exception would be lost.
        def __bool__(self):
            return True

    Seeded.__name__ = Seeded.__qualname__ = collector_class.__name__
    return Seeded
