"""Transforms on arrays: what VectorCollector calls, and the same for two of TorchRL's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from torchrl.envs import InitTracker, RewardSum
from torchrl.envs.transforms import Transform

from torchrl_etl.collectors.policy_on_arrays import Arrays

__all__ = ["ArrayTransform", "has_array_form", "on_arrays"]


@runtime_checkable
class ArrayTransform(Protocol):
    """Methods by which a transform works under :class:`~torchrl_etl.collectors.VectorCollector`.

    A transform that maps the policy's action to the env's also has ``array_action(now)``, which
    returns the env's action [num_envs, n] and may write root entries.
    """

    def array_step(self, now: Arrays, after: Arrays) -> None:
        """After a step: write entries below ``"next"`` into ``after``; ``now`` is the root."""

    def array_reset(self, now: Arrays, fresh: Arrays, done: np.ndarray) -> None:
        """Write into ``fresh`` the root entries that the next step starts from.

        ``now`` has the entries of all rows so far, of which those in ``done`` [num_envs] ended.
        """


def has_array_form(transform: Transform) -> bool:
    """Whether :func:`on_arrays` finds the methods above."""
    return isinstance(transform, ArrayTransform) or type(transform) in _COUNTERPARTS


def on_arrays(transform: Transform) -> ArrayTransform | None:
    """The transform, or its counterpart below, with the methods above; ``None`` if it has none."""
    if isinstance(transform, ArrayTransform):
        return transform
    counterpart = _COUNTERPARTS.get(type(transform))
    return None if counterpart is None else counterpart(transform)


class _RewardSum:
    def __init__(self, transform: RewardSum) -> None:
        self._keys = [*zip(transform.in_keys, transform.out_keys, strict=True)]

    def array_step(self, now: Arrays, after: Arrays) -> None:
        for reward, total in self._keys:
            after[total] = now[total] + after[reward]

    def array_reset(self, now: Arrays, fresh: Arrays, done: np.ndarray) -> None:
        for _, total in self._keys:
            fresh[total] = np.where(done[:, None], np.float32(0), now[total])


class _InitTracker:
    def __init__(self, transform: InitTracker) -> None:
        self._key = transform.out_keys[0]

    def array_step(self, now: Arrays, after: Arrays) -> None:
        after[self._key] = np.zeros_like(after["done"])

    def array_reset(self, now: Arrays, fresh: Arrays, done: np.ndarray) -> None:
        fresh[self._key] = done[:, None]


# Exactly these classes: a subclass may compute something else.
_COUNTERPARTS: dict[type, Callable[[Any], ArrayTransform]] = {
    RewardSum: _RewardSum,
    InitTracker: _InitTracker,
}
