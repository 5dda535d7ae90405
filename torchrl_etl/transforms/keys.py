"""Keys of transforms: their group in an environment, and conflicts with other writers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, expand_right, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, TensorDictPrimer, Transform

__all__ = [
    "SoleWriter",
    "check_network",
    "group_shape",
    "private_key",
    "set_leaf",
    "set_where_reset",
]


def group_shape(env: EnvBase, key: NestedKey) -> torch.Size:
    """Batch size of the group (of agents, say) that contains ``key``, else of the environment.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> group_shape(GymEnv("Pendulum-v1"), ("agents", "direction"))
        torch.Size([])
    """
    shape = env.batch_size
    if isinstance(key, str):
        return shape
    for spec in (env.full_observation_spec, env.full_action_spec, env.full_reward_spec):
        for node in _groups(spec, key):
            shape = max(shape, node.shape, key=len)
    return shape


def set_leaf(spec: Composite, key: NestedKey, leaf: TensorSpec, env: EnvBase) -> None:
    """Declare a leaf; groups missing from ``spec`` get their batch size in the environment."""
    path = (key,) if isinstance(key, str) else key
    for depth in range(1, len(path)):
        group = unravel_key(path[:depth])
        if group not in spec.keys(True):
            shape = group_shape(env, (*path[:depth], ""))
            spec[group] = Composite(shape=shape, device=spec.device)
    spec[key] = leaf


def set_where_reset(
    env: EnvBase,
    tensordict: TensorDictBase,
    tensordict_reset: TensorDictBase,
    key: NestedKey,
    fresh: Tensor,
) -> TensorDictBase:
    """Set ``fresh`` where the group of ``key`` begins a new episode; keep the old value elsewhere.

    At a native autoreset TorchRL does not merge by the reset mask.
    """
    reset = expand_as_right(_group_reset(env, tensordict, key), fresh)
    return tensordict_reset.set(key, torch.where(reset, fresh, tensordict.get(key)))


def _group_reset(env: EnvBase, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Mask, of the group's shape, of the elements in ``key``'s group that begin a new episode."""
    path = (key,) if isinstance(key, str) else key
    own = [
        reset_key
        for reset_key in env.reset_keys
        if isinstance(reset_key, str) or reset_key[:-1] == path[: len(reset_key) - 1]
    ]
    reset_key = max(own, key=lambda found: 0 if isinstance(found, str) else len(found))
    mask = tensordict.get(reset_key).reshape(group_shape(env, reset_key))
    return expand_right(mask, group_shape(env, key))


def private_key(owner: NestedKey, key: NestedKey) -> NestedKey:
    """A key beside ``key`` that only ``owner`` reads; collectors leave it out of batches.

    Examples:
        >>> private_key("bonus", ("agents", "observation"))
        ('agents', '_bonus_observation')
    """
    *group, name = (key,) if isinstance(key, str) else key
    owner = owner if isinstance(owner, str) else owner[-1]
    return unravel_key((*group, f"_{owner}_{name}"))


def check_network(name: str, network: object, reads: Sequence[str], writes: str) -> None:
    """Check that a network has an in-key for each of ``reads``, and one out-key.

    Errors call the network ``name`` and its out-key ``writes``.
    """
    if not (hasattr(network, "in_keys") and hasattr(network, "out_keys")):
        raise TypeError(
            f"The {name} is a {type(network).__name__} without in_keys and out_keys; wrap it in a "
            "tensordict.nn.TensorDictModule."
        )
    if len(network.in_keys) != len(reads) or len(network.out_keys) != 1:
        raise ValueError(
            f"The {name} reads {list(network.in_keys)} and writes {list(network.out_keys)}; it "
            f"must read {' and '.join(reads)}, and write {writes}."
        )


class SoleWriter(Transform):
    """A transform that cannot be attached where something else writes its out-keys."""

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        refuse_shared_keys(self, output_spec, self.out_keys)
        return super().transform_output_spec(output_spec)

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        if self.parent is not None:
            try:
                refuse_shared_keys(self, self.parent.output_spec, self.out_keys)
            except ValueError:
                self.reset_parent()
                raise


def refuse_shared_keys(
    transform: Transform, output_spec: Composite, keys: Iterable[NestedKey]
) -> None:
    """Raise if a key is already in the spec, or if a later transform also writes it.

    A later transform may rewrite keys that it reads, as scalings and normalizations do.

    Raises:
        ValueError: with the key and its other writer.
    """
    name = type(transform).__name__
    cure = f"give one of them another key, such as {name}(..., out_key=...)."
    present = {
        key
        for kind in ("full_observation_spec", "full_reward_spec")
        for key in output_spec[kind].keys(True, True)
    }
    for key in keys:
        if key in present:
            raise ValueError(
                f"{name} writes {key!r}, which the environment or a transform before it writes "
                f"already; {cure}"
            )
        for other in _later(transform):
            if key in _writes(other) and key not in (other.in_keys or ()):
                raise ValueError(
                    f"{name} and {type(other).__name__} both write {key!r}, and the later one "
                    f"would overwrite the other; {cure}"
                )


def _groups(spec: Composite, key: tuple[str, ...]) -> Iterator[Composite]:
    """Nodes of a spec on the path to ``key``."""
    for name in key[:-1]:
        if not isinstance(spec, Composite) or name not in spec.keys():
            return
        spec = spec[name]
        yield spec


def _writes(transform: Transform) -> set[NestedKey]:
    own = transform.primers.keys(True, True) if isinstance(transform, TensorDictPrimer) else ()
    with suppress(NotImplementedError):  # as TorchRL's InitTracker has none outside an env
        own = (*own, *(transform.out_keys or ()))
    return {unravel_key(key) for key in own}


def _later(transform: Transform) -> Iterator[Transform]:
    """Transforms after this one in its ``Compose``; those before it have declared their keys."""
    reference = transform.__dict__.get("_container")
    container = reference() if reference is not None else None
    if isinstance(container, Compose):
        siblings = list(container.transforms)
        yield from siblings[[other is transform for other in siblings].index(True) + 1 :]
