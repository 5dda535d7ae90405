"""Factory for all collectors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, get_args

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from torchrl_etl.checks import check_choice
from torchrl_etl.collectors.batches import Batches
from torchrl_etl.collectors.process import AsyncProcessWorkers, ProcessWorkers
from torchrl_etl.collectors.vector import VectorCollector

__all__ = ["COLLECTORS", "Kind", "make_batches"]

Kind = Literal["single", "process", "async", "ray", "distributed"]
COLLECTORS: tuple[Kind, ...] = get_args(Kind)


def make_batches(
    kind: Kind,
    make_env: Callable[[], EnvBase],
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    collector_class: type[Collector] = VectorCollector,
    num_workers: int = 1,
    seed: int = 0,
    ahead: bool = False,
    timeout: float = 120.0,
    device: torch.device | str = "cpu",
    ray: Mapping[str, Any] | None = None,
    distributed: Mapping[str, Any] | None = None,
) -> Batches:
    """Batches of transitions from one process, several processes, or several machines.

    Args:
        kind (str): ``"single"`` collects in this process; ``"process"`` in worker processes that
            each contribute a part of every batch; ``"async"`` in worker processes that never wait,
            with one worker's frames per batch; ``"ray"`` on a Ray cluster; ``"distributed"`` in a
            torch.distributed group.
        make_env (callable): builds a worker's environment, on the CPU.
        policy (TensorDictModuleBase): behavior policy. A synergy decoder must be part of it, so
            that the decoder's weights are sent along.

    Keyword Args:
        frames_per_batch (int): frames of a batch.
        collector_class (type): class of each worker's collector. Defaults to
            :class:`~torchrl_etl.collectors.VectorCollector`, which needs batched environments.
        num_workers (int): number of workers; ignored by ``"single"``.
        seed (int): seeds ``"ray"`` and ``"distributed"``; the others are seeded by
            :meth:`Batches.restart`.
        ahead (bool): with ``"process"``, collect the next batch while the learner updates.
        timeout (float): longest wait in seconds.
        device (torch.device): policy device of ``"single"``; workers act on the CPU.
        ray, distributed (mapping): further arguments of
            :class:`~torchrl_etl.collectors.ray.RayWorkers` and
            :class:`~torchrl_etl.collectors.distributed.DistributedWorkers`.

    Raises:
        ValueError: for an unknown kind or bad arguments.
        ImportError: if Ray or submitit is needed and not installed.
    """
    check_choice("kind", kind, COLLECTORS)
    common = {"frames_per_batch": frames_per_batch, "total_frames": -1}
    trusting = {"trust_policy": True, "auto_register_policy_transforms": False}
    workers = {**common, "num_workers": num_workers, "collector_class": collector_class}
    remote = {**workers, "seed": seed, "timeout": timeout}
    match kind:
        case "single":
            devices = {"policy_device": device, "storing_device": device}
            make = partial(collector_class, make_env, policy, **common, **trusting, **devices)
            return Batches(make, in_process=True)
        case "process":
            make = partial(ProcessWorkers, make_env, policy, **workers, **trusting)
            return Batches(make, ahead=ahead, timeout=timeout)
        case "async":
            make = partial(AsyncProcessWorkers, make_env, policy, **workers, **trusting)
            return Batches(make, restarts=False, timeout=timeout)
        case "ray":
            from torchrl_etl.collectors.ray import RayWorkers

            make = partial(RayWorkers, make_env, policy, **remote, **ray or {})
            return Batches(make, restarts=False, timeout=2 * timeout)
        case "distributed":
            from torchrl_etl.collectors.distributed import DistributedWorkers

            make = partial(DistributedWorkers, make_env, policy, **remote, **distributed or {})
            return Batches(make, restarts=False, timeout=2 * timeout)
