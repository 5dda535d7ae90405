"""An argument check that several losses share."""

from __future__ import annotations

from torch import nn

__all__ = ["check_parts"]


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
