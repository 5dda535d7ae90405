"""Collector workers in local processes."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase

from torchrl_etl.collectors.vector import VectorCollector
from torchrl_etl.collectors.worker_process import exit_with_learner, stop_signals_blocked

__all__ = ["AsyncProcessWorkers", "ProcessWorkers"]


class _OwnWeights:
    """Workers that act with a copy of the policy, updated only on request.

    TorchRL 0.14.1 moves the learner's policy into shared memory, so every optimizer step would
    change the workers' policy during a rollout.
    """

    def __init__(
        self,
        create_env_fn: Callable[[], EnvBase],
        policy: TensorDictModuleBase,
        *,
        num_workers: int,
        **kwargs: Any,
    ) -> None:
        kwargs = {"collector_class": VectorCollector, "use_buffers": True, **kwargs}
        with stop_signals_blocked():  # workers inherit this; their imports take seconds
            super().__init__(
                [create_env_fn] * num_workers,
                deepcopy(policy).cpu(),
                init_fn=exit_with_learner,
                num_threads=torch.get_num_threads(),  # TorchRL would subtract one per worker
                **kwargs,
            )
        self._learner = policy

    def update_policy_weights_(
        self, policy_or_weights: TensorDictBase | nn.Module | None = None, **kwargs: Any
    ) -> None:
        """Send weights to the workers. Default: the learner's current weights."""
        super().update_policy_weights_(
            self._learner if policy_or_weights is None else policy_or_weights, **kwargs
        )

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """Stop the workers and the weight-sync schemes.

        TorchRL 0.14.1 stops the schemes in ``__del__``, which hangs at interpreter exit, when no
        thread can be started.
        """
        super().shutdown(*args, **kwargs)
        for scheme in (self._weight_sync_schemes or {}).values():
            scheme.shutdown()


class ProcessWorkers(_OwnWeights, MultiSyncCollector):
    """TorchRL's ``MultiSyncCollector``: each batch has one part from each worker.

    A whole rollout uses the weights of the last :meth:`update_policy_weights_` before its request.

    Args:
        create_env_fn (callable): builds a worker's environment.
        policy (TensorDictModuleBase): behavior policy; workers get a copy.

    Keyword Args:
        num_workers (int): number of processes.
        frames_per_batch (int): frames of a batch over all workers.
        **kwargs: see :class:`torchrl.collectors.MultiSyncCollector`; ``collector_class`` defaults
            to :class:`~torchrl_etl.collectors.VectorCollector`.

    Examples:
        >>> from functools import partial
        >>> from torchrl_etl.collectors import ProcessWorkers
        >>> from torchrl_etl.envs import make_env
        >>> from torchrl_etl.modules import make_actor
        >>> make = partial(make_env, "overactuated", num_envs=4)
        >>> actor = make_actor({"observation": 6}, make().full_action_spec_unbatched["action"])
        >>> collector = ProcessWorkers(  # doctest: +SKIP
        ...     make, actor, num_workers=2, frames_per_batch=64, total_frames=-1
        ... )
    """


class AsyncProcessWorkers(_OwnWeights, MultiAsyncCollector):
    """TorchRL's ``MultiAsyncCollector``: each batch is from one worker, and workers never wait.

    New weights may arrive during a rollout. Transitions record the executed actions and stay
    valid; only their behavior policy is a mixture.

    Arguments are those of :class:`ProcessWorkers`, with ``frames_per_batch`` per worker.
    """
