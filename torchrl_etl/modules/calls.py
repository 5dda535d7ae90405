"""Keys of TensorDictModules, and whether one only calls its module."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

__all__ = ["as_keys", "calls_module_only"]


def as_keys(keys: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """A list of keys; a string is one key, while a tuple is several.

    TensorDictModule would take a tuple for one nested key.

    Examples:
        >>> as_keys("action"), as_keys(("loc", "scale"))
        (['action'], ['loc', 'scale'])
    """
    return [keys] if isinstance(keys, str) else [*keys]


def calls_module_only(network: TensorDictModule) -> bool:
    """Whether a network only passes entries to its module by position.

    The module can then be called on tensors directly, in a fraction of the time.
    """
    return (
        type(network).forward is TensorDictModule.forward
        and isinstance(network.module, nn.Module)
        and network._kwargs is None  # inputs passed by keyword
        and network.method is None
        and not network.method_kwargs
        and not network._forward_hooks
        and not network._forward_pre_hooks
    )
