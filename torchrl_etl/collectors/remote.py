"""What collectors with workers on other machines share: seeds, weights, order of batches, words."""

from __future__ import annotations

import sys
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
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
    "worker_seed",
]

MANAGED = {"create_env_fn", "policy", "policy_factory", "frames_per_batch", "total_frames"}
MANAGED |= {"split_trajs", "replay_buffer", "weight_updater", "weight_sync_schemes"}


class RemoteWorkers:
    """The loop of a learner whose batches come from workers that it shares no memory with.

    A worker is asked for one batch at a time. With the request go the newest weights, unless the
    worker has them; so a batch is collected with one set of weights from its first frame to
    its last, and however often the learner pushes, a worker receives weights once a batch.

    Synchronous: all workers are asked at once and their batches stacked, ``[workers, *batch]``. A
    push is in the very next batch. Asynchronous: batches come as they are ready, and a worker is
    asked again before the learner gets its batch. When the learner pushes, one batch a worker is
    under way (or waits to be fetched) with older weights; the one after it has the new ones.

    Each batch says where it comes from: ``("collector", "worker")`` is the index of the worker and
    ``("collector", "policy_version")`` the number of pushes when it was asked for.

    Subclasses are TorchRL collectors; they define how a worker is asked and how its answer comes.

    Args:
        create_env_fn (callable): builds a worker's environment.
        policy (TensorDictModuleBase): what workers act with. It is copied; changes to its
            parameters reach the workers through :meth:`update_policy_weights_`.

    Keyword Args:
        num_workers (int): number of workers.
        frames_per_batch (int): frames of a batch: over all workers if ``sync``, else of the one
            worker that it comes from.
        total_frames (int): iteration ends there. Defaults to -1: no end.
        sync (bool): one stacked batch of all workers instead of the first that is ready.
            Defaults to ``False``.
        seed (int): each worker gets its own seed from it. Defaults to 0.
        timeout (float): most seconds to wait for anything. Defaults to 300.
        collector_class (type): class of the workers' collectors. Defaults to
            :class:`~torchrl.collectors.Collector`.
        collector_kwargs (mapping, optional): more arguments for it.

    Raises:
        TypeError, ValueError: for bad arguments, before anything is started.
        RuntimeError: if workers do not start in time, or are lost.
    """

    policy: TensorDictModuleBase
    timeout: float

    def _prepare(self, policy: nn.Module, sync: bool, total_frames: int, timeout: float) -> None:
        self.timeout, self._sync = timeout, sync
        # TorchRL 0.14.1 takes the -1 of "no limit" for a limit that is reached already.
        self.total_frames = sys.maxsize if total_frames < 0 else total_frames
        self.collected_frames, self._stopped = 0, False
        self.policy_version, self._known = 0, {}
        self._weights = weights_of(policy)

    @abstractmethod
    def _ask(self, worker: int) -> None:
        """Sends the worker :attr:`_weights` if they are news to it, and asks it for a batch."""

    @abstractmethod
    def _take(self) -> tuple[int, TensorDictBase]:
        """The next batch of any worker that was asked, within the limit."""

    def iterator(self) -> Iterator[TensorDictBase]:
        workers = range(self.num_workers)
        if not self._sync:
            for worker in workers:
                self._ask(worker)
        while self.collected_frames < self.total_frames and not self._stopped:
            if self._sync:
                for worker in workers:
                    self._ask(worker)
                batches = dict(self._take() for _ in workers)
                batch = torch.stack([batches[worker] for worker in workers])
            else:
                worker, batch = self._take()
                self._ask(worker)
            self.collected_frames += batch.numel()
            yield batch

    def _signed(self, batch: TensorDictBase, worker: int) -> TensorDictBase:
        """The batch with its origin; to be called before the worker is asked again."""
        batch["collector", "worker"] = torch.full(batch.shape, worker)
        batch["collector", "policy_version"] = torch.full(batch.shape, self._known[worker])
        return batch

    def _news(self, worker: int) -> bool:
        """Whether the worker lacks the newest weights; it counts as having them from now on."""
        news = self._known.get(worker) != self.policy_version
        self._known[worker] = self.policy_version
        return news

    def update_policy_weights_(
        self, policy_or_weights: nn.Module | TensorDictBase | None = None
    ) -> None:
        """Makes weights those of every batch that is asked for from now on; returns at once.

        Args:
            policy_or_weights (nn.Module or TensorDictBase, optional): a policy, or its weights.
                Defaults to the policy of the constructor as it is now.
        """
        self._weights = weights_of(self.policy if policy_or_weights is None else policy_or_weights)
        self.policy_version += 1

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Not possible once workers run: pass ``seed`` to the constructor."""
        raise RuntimeError(
            f"{type(self).__name__} seeds its workers when they start: pass seed={seed} to the "
            "constructor, or build a new collector."
        )

    def _lost(self, worker: int, cause: str) -> RuntimeError:
        advice = ""
        if self.collected_frames:
            advice = (
                f" The {self.collected_frames} frames delivered so far were counted once; go on "
                "from the last checkpoint: resume=FOLDER."
            )
        return RuntimeError(f"{type(self).__name__}: worker {worker} {cause}.{advice}")


def seeded_env(create_env_fn: Callable[[], EnvBase], seed: int) -> EnvBase:
    """In a worker: the environment, with its simulators and torch's generator seeded.

    A fresh process seeds torch by chance and a forked one inherits the generator of its parent;
    seeded here, workers differ, and what they do can be repeated.
    """
    torch.manual_seed(seed)
    env = create_env_fn()
    env.set_seed(seed)
    return env


def training_seed(seed: int, offset: int) -> int:
    """A seed for the part of a run that ``offset`` names.

    It has its highest bit set, which no evaluation seed has.

    Examples:
        >>> training_seed(0, 0) == 2**30
        True
        >>> training_seed(1, 5) - training_seed(1, 0)
        5
    """
    return 2**30 + (seed * 1_000_003 + offset) % 2**30


def worker_seed(seed: int, index: int) -> int:
    """Seed of the ``index``-th worker of a run.

    Steps of the golden ratio of the range keep the seeds of any number of workers apart.

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
    """What workers start with; their machines may lack the learner's device."""
    return deepcopy(policy).to("cpu")


def check_arguments(
    create_env_fn: Any,
    policy: Any,
    *,
    num_workers: int,
    frames_per_batch: int,
    sync: bool,
    timeout: float,
    collector_class: Any,
    collector_kwargs: Mapping[str, Any],
) -> None:
    """Raises ValueError or TypeError with what was got, what is expected and how to mend it."""
    if not callable(create_env_fn) or isinstance(create_env_fn, EnvBase):
        raise TypeError(
            f"create_env_fn is a {type(create_env_fn).__name__}; workers build their own "
            "environments, so pass a function: lambda: make_env(...)."
        )
    if not isinstance(policy, TensorDictModuleBase):
        raise TypeError(
            f"policy is a {type(policy).__name__}; its weights travel by their names, so it "
            "must be a TensorDictModule such as TensorDictSequential(actor, decoder)."
        )
    check_integer(1, num_workers=num_workers, frames_per_batch=frames_per_batch)
    if sync and frames_per_batch % num_workers:
        raise ValueError(
            f"frames_per_batch={frames_per_batch} cannot be shared equally by "
            f"num_workers={num_workers}; a multiple of it near by is "
            f"{num_workers * max(1, round(frames_per_batch / num_workers))}."
        )
    check_real("(0, inf)", timeout=timeout)
    if not (isinstance(collector_class, type) and issubclass(collector_class, Collector)):
        raise TypeError(
            f"collector_class is {collector_class!r}; a worker runs one environment in its own "
            "process, so it must be torchrl.collectors.Collector or a subclass. For more "
            "simulators in a worker use make_env(..., num_envs=N); for more processes, num_workers."
        )
    managed = sorted(MANAGED & set(collector_kwargs))
    if managed:
        raise ValueError(f"collector_kwargs may not hold {', '.join(managed)}: set by the workers.")
