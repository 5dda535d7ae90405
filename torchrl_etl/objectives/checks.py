"""Argument checks that several losses share."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

from tensordict.utils import NestedKey, unravel_key
from torch import nn

__all__ = ["check_parts", "warn_of_previous_action"]


def warn_of_previous_action(reader: str, keys: Iterable[NestedKey]) -> None:
    """Warn if a loss reads root ``executed_action``, which belongs to the step before.

    Examples:
        >>> warn_of_previous_action("DecoderLoss", ["action", ("next", "executed_action")])
    """
    for key in map(unravel_key, keys):
        path = (key,) if isinstance(key, str) else key
        if path[-1] == "executed_action" and path[0] != "next":
            warnings.warn(
                f"{reader} reads {key!r} at the root, which SynergyAction leaves there from the "
                "step before; read 'action' in a collector's batches, or ('next', "
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
