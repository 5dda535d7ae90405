"""Common code of the Ray and torch.distributed collectors: seeds, weights, requests, errors."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from torchrl_etl.checks import check_integer, check_real

__all__ = [
    "RemoteWorkers",
    "check_arguments",
    "cpu_copy",
    "seeded_env",
    "training_seed",
    "weights_of",
    "worker_options",
    "worker_seed",
]

MANAGED = {"create_env_fn", "policy", "policy_factory", "frames_per_batch", "total_frames"}
MANAGED |= {"split_trajs", "replay_buffer", "weight_updater", "weight_sync_schemes"}
# Arguments that only the loop of TorchRL's own collectors reads. Splitting would also mix up the
# workers' trajectories, since each counts its own.
_NOT_TAKEN = (
    "split_trajs",
    "replay_buffer",
    "update_after_each_batch",
    "max_weight_update_interval",
    "update_interval",
)


class RemoteWorkers:
    """Collection loop for workers that share no memory with the learner.

    Each worker has at most one pending request. The newest weights are sent with it, unless the
    worker already has them. A batch is thus collected with one set of weights, and a worker
    receives weights at most once per batch, however often the learner pushes.

    Synchronous: all workers are asked at once and their batches are stacked,
    ``[workers, *batch]``. A push takes effect in the next batch. Asynchronous: batches arrive as
    they are ready, and a worker gets its next request before the learner gets the batch. After a
    push, each worker delivers one more batch collected with older weights.

    Each batch records its origin: ``("collector", "worker")`` is the index of the worker and
    ``("collector", "policy_version")`` the number of pushes before the request.

    Subclasses are TorchRL collectors that implement the requests and replies.

    Args:
        create_env_fn (callable): builds a worker's environment.
        policy (TensorDictModuleBase): behavior policy. Workers get a copy, which
            :meth:`update_policy_weights_` updates.

    Keyword Args:
        num_workers (int): number of workers.
        frames_per_batch (int): frames of a batch: over all workers if ``sync``, else per worker.
        total_frames (int): frames after which iteration ends. Defaults to -1: no limit.
        sync (bool): one stacked batch of all workers instead of the first that is ready.
            Defaults to ``False``.
        seed (int): determines the seed of each worker. Defaults to 0.
        timeout (float): longest wait in seconds. Defaults to 300.
        collector_class (type): class of the workers' collectors. Defaults to
            :class:`~torchrl.collectors.Collector`.
        collector_kwargs (mapping, optional): further arguments of ``collector_class``.
        postproc (callable, optional): applied to each batch, in this process.

    Raises:
        TypeError, ValueError: for bad arguments, before workers are started.
        RuntimeError: if workers do not start in time, or are lost.
    """

    policy: TensorDictModuleBase
    postproc: Callable[[TensorDictBase], TensorDictBase] | None
    num_workers: int
    timeout: float

    def _prepare(self, policy: nn.Module, sync: bool, total_frames: int, timeout: float) -> None:
        self.timeout, self._sync = timeout, sync
        # TorchRL 0.14.1 treats -1 ("no limit") as a limit that has been reached.
        self.total_frames = sys.maxsize if total_frames < 0 else total_frames
        self.collected_frames, self._stopped = 0, False
        self.policy_version = 0
        self._known: dict[int, int] = {}
        self._weights = weights_of(policy)

    @abstractmethod
    def _request(self, worker: int) -> None:
        """Send the worker :attr:`_weights` if it lacks them, and request a batch."""

    @abstractmethod
    def _receive(self) -> tuple[int, TensorDictBase]:
        """The next batch of any worker with a pending request, within the timeout."""

    @abstractmethod
    def _requested(self) -> Collection[int]:
        """Workers with a pending request."""

    def iterator(self) -> Iterator[TensorDictBase]:
        """Batches until ``total_frames``. Another iterator goes on where the last one was left."""
        workers = range(self.num_workers)
        while self.collected_frames < self.total_frames and not self._stopped:
            for worker in {*workers}.difference(self._requested()):
                self._request(worker)
            if self._sync:
                batches = dict(self._receive() for _ in workers)
                batch = torch.stack([batches[worker] for worker in workers])
            else:
                worker, batch = self._receive()
                self._request(worker)
            self.collected_frames += batch.numel()
            yield batch if self.postproc is None else self.postproc(batch)

    def _with_origin(self, batch: TensorDictBase, worker: int) -> TensorDictBase:
        """The batch with its origin. Call it before the worker's next request."""
        batch["collector", "worker"] = torch.full(batch.shape, worker)
        batch["collector", "policy_version"] = torch.full(batch.shape, self._known[worker])
        return batch

    def _needs_weights(self, worker: int) -> bool:
        """Whether the worker lacks the newest weights. Marks them as sent."""
        news = self._known.get(worker) != self.policy_version
        self._known[worker] = self.policy_version
        return news

    def update_policy_weights_(
        self, policy_or_weights: nn.Module | TensorDictBase | None = None
    ) -> None:
        """Set the weights for all later requests. Returns at once.

        Args:
            policy_or_weights (nn.Module or TensorDictBase, optional): a policy, or its weights.
                Defaults to the current weights of the constructor's policy.

        Raises:
            ValueError: if they do not have the names and shapes of the constructor's policy.
        """
        weights = weights_of(self.policy if policy_or_weights is None else policy_or_weights)
        shapes, known = (
            {key: tuple(value.shape) for key, value in each.items(True, True)}
            for each in (weights, self._weights)
        )
        if shapes != known:
            key = min({*shapes.items()} ^ {*known.items()}, key=str)[0]
            raise ValueError(
                f"The shape of the weights {key!r} is {shapes.get(key)}, and {known.get(key)} in "
                "the policy that the workers have; build a new collector for another policy."
            )
        self._weights = weights
        self.policy_version += 1

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Always raises: workers are seeded when they start; pass ``seed`` to the constructor."""
        raise RuntimeError(
            f"{type(self).__name__} seeds its workers when they start: pass seed={seed} to the "
            "constructor, or build a new collector."
        )

    def _lost(self, worker: int, cause: str) -> RuntimeError:
        advice = ""
        if self.collected_frames:
            advice = (
                f" The {self.collected_frames} frames delivered so far were counted once; continue "
                "from your last checkpoint."
            )
        return RuntimeError(f"{type(self).__name__}: worker {worker} {cause}.{advice}")


def seeded_env(create_env_fn: Callable[[], EnvBase], seed: int) -> EnvBase:
    """Build a worker's environment, with its simulators and torch's generator seeded.

    Otherwise a spawned process would seed torch randomly, and a forked one would inherit its
    parent's generator. With a seed each, workers differ and are reproducible.
    """
    torch.manual_seed(seed)
    env = create_env_fn()
    env.set_seed(seed)
    return env


def training_seed(seed: int, offset: int) -> int:
    """A seed for the part of a run given by ``offset``.

    Bit 30 is set, which it is in no evaluation seed.

    Examples:
        >>> training_seed(0, 0) == 2**30
        True
        >>> training_seed(1, 5) - training_seed(1, 0)
        5
    """
    return 2**30 + (seed * 1_000_003 + offset) % 2**30


def worker_seed(seed: int, index: int) -> int:
    """Seed of the ``index``-th worker of a run.

    Golden-ratio steps keep the seeds of any number of workers apart.

    Examples:
        >>> len({worker_seed(0, index) for index in range(1000)})
        1000
    """
    return training_seed(seed, index * 663_608_941)


def weights_of(policy: nn.Module | TensorDictBase) -> TensorDictBase:
    """A copy of a policy's parameters and buffers, on the CPU and detached."""
    if isinstance(policy, nn.Module):
        policy = TensorDict.from_module(policy)
    return policy.data.to("cpu").clone()


def cpu_copy(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """A copy on the CPU for workers, whose machines may lack the learner's device."""
    return deepcopy(policy).to("cpu")


def check_arguments(
    create_env_fn: Any,
    policy: Any,
    num_workers: int,
    frames_per_batch: int,
    sync: bool,
    timeout: float,
    others: Mapping[str, Any],
) -> None:
    """Raise ValueError or TypeError with the value, what is expected, and a fix."""
    if not callable(create_env_fn) or isinstance(create_env_fn, EnvBase):
        raise TypeError(
            f"create_env_fn is a {type(create_env_fn).__name__}; workers build their own "
            "environments, so pass a function: lambda: make_env(...)."
        )
    if not isinstance(policy, TensorDictModuleBase):
        raise TypeError(
            f"policy is a {type(policy).__name__}; its weights are sent by name, so it must be a "
            "TensorDictModule such as TensorDictSequential(actor, decoder)."
        )
    check_integer(1, num_workers=num_workers, frames_per_batch=frames_per_batch)
    if sync and frames_per_batch % num_workers:
        raise ValueError(
            f"frames_per_batch is {frames_per_batch}; it must be a multiple of "
            f"num_workers={num_workers}, such as "
            f"{num_workers * max(1, round(frames_per_batch / num_workers))}."
        )
    check_real("(0, inf)", timeout=timeout)
    unused = [name for name in _NOT_TAKEN if others.get(name) not in (None, False, -1)]
    if unused:
        raise ValueError(
            f"The workers take no {unused[0]}; leave it out, push weights with "
            "update_policy_weights_(), and store or split the batches that you get."
        )


def worker_options(
    collector_class: Any, collector_kwargs: Mapping[str, Any] | None
) -> dict[str, Any]:
    """``collector_kwargs`` with our default. Raises as :func:`check_arguments` does."""
    if not (isinstance(collector_class, type) and issubclass(collector_class, Collector)):
        raise TypeError(
            f"collector_class is {collector_class!r}; a worker runs one environment in its own "
            "process, so it must be torchrl.collectors.Collector or a subclass. For more "
            "simulators in a worker use make_env(..., num_envs=N); for more processes, num_workers."
        )
    managed = sorted(MANAGED.intersection(collector_kwargs or ()))
    if managed:
        raise ValueError(
            f"collector_kwargs has {', '.join(managed)}, which the workers set; leave them out."
        )
    return {"auto_register_policy_transforms": False, **(collector_kwargs or {})}
