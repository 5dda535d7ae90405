"""Argument checks that several losses share."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

__all__ = ["check_parts", "read", "warn_of_previous_action"]


def read(
    reader: str, tensordict: TensorDictBase, key: NestedKey, *prefix: str, cure: str = ""
) -> Tensor:
    """Get an entry, or raise a ``KeyError`` that names it and how to get it.

    Examples:
        >>> from tensordict import TensorDict
        >>> read("DecoderLoss", TensorDict({"synergy": 0.0}), "action")
        Traceback (most recent call last):
        ...
        KeyError: "DecoderLoss reads 'action', which the data lacks; there it has synergy."
    """
    value = tensordict.get(key, None)
    if value is None:
        there = tensordict.keys(True, True)
        if not cure and key == "action" and ("next", "executed_action") in there:
            cure = (
                "RenameTransform([('next', 'executed_action')], ['action'], create_copy=True) "
                "makes one from the executed action"
            )
        raise KeyError(
            f"{reader} reads {unravel_key((*prefix, key))!r}, which the data lacks; there it has "
            f"{', '.join(sorted(map(str, there)))}{cure and f'; {cure}'}."
        )
    return value


def warn_of_previous_action(reader: str, keys: Iterable[NestedKey]) -> None:
    """Warn if a loss reads root ``executed_action``, which belongs to the previous step.

    Examples:
        >>> warn_of_previous_action("DecoderLoss", ["action", ("next", "executed_action")])
    """
    for key in map(unravel_key, keys):
        path = (key,) if isinstance(key, str) else key
        if path[-1] == "executed_action" and path[0] != "next":
            warnings.warn(
                f"{reader} reads {key!r} at the root, where SynergyAction keeps that of the "
                "previous step; read 'action' in a collector's batches, or ('next', "
                "'executed_action').",
                stacklevel=4,
            )


def check_parts(name: str, module: object, kind: type[nn.Module], *, outputs: int = 0) -> None:
    """Raise a ``TypeError`` when ``module`` is not a ``kind`` or writes too few keys.

    Examples:
        >>> from torch import nn
        >>> from torchrl_etl.objectives.checks import check_parts
        >>> check_parts("encoder", nn.Linear(2, 2), nn.Conv1d)
        Traceback (most recent call last):
        ...
        TypeError: encoder is a Linear; pass a Conv1d.
    """
    if not isinstance(module, kind):
        raise TypeError(f"{name} is a {type(module).__name__}; pass a {kind.__name__}.")
    if outputs and len(module.out_keys) < outputs:
        raise TypeError(f"{name} writes {module.out_keys}; it must write {outputs} key(s).")
