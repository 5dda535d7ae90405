"""What a TensorDictModule does beside calling its module."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torch import nn

__all__ = ["calls_module_only"]


def calls_module_only(network: TensorDictModule) -> bool:
    """Whether a network hands entries to its module by position, and does no more.

    Its module can then be called without the tensordict around it, at a fraction of the time.
    """
    return (
        type(network).forward is TensorDictModule.forward
        and isinstance(network.module, nn.Module)
        and network._kwargs is None  # names of inputs by keyword
        and network.method is None
        and not network.method_kwargs
        and not network._forward_hooks
        and not network._forward_pre_hooks
    )
