"""Detects TensorDictModules that only call their module."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torch import nn

__all__ = ["calls_module_only"]


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
