"""Argument checks that several losses share."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

__all__ = ["check_choice", "check_parts"]


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise a ``ValueError`` naming the valid choices when ``value`` is not among them.

    Examples:
        >>> from torchrl_etl.objectives.checks import check_choice
        >>> check_choice("reduction", "mean", ("mean", "sum", "none"))
        >>> check_choice("reduction", "avg", ("mean", "sum", "none"))
        Traceback (most recent call last):
        ...
        ValueError: reduction is 'avg'; choose one of 'mean', 'sum', 'none'.
    """
    if value not in choices:
        raise ValueError(f"{name} is {value!r}; choose one of {', '.join(map(repr, choices))}.")


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
