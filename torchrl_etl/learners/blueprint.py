"""What an objective is apart from the values of its tensors."""

from __future__ import annotations

from enum import Enum
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_etl.learners.objective import Objective

__all__ = ["blueprint"]

_CONSTANTS = (bool, int, float, str, type, torch.dtype, Enum, type(None))
_HOOKS = {*vars(nn.Module())} - {"_parameters", "_buffers", "_modules"}


def blueprint(objective: Objective) -> str:
    """Types, shapes and constants of an objective, as text.

    Objectives with equal blueprints differ only in their parameters and buffers, so one of them can
    be evaluated with the tensors of another. Constants inside functions are not seen.

    Examples:
        >>> from torchrl_etl.learners import Term
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> from torchrl_etl.objectives import DecoderLoss
        >>> def weighted(weight):
        ...     term = Term(DecoderLoss(SynergyDecoder(2, 6)), weight=weight)
        ...     return blueprint(Objective(None, nn.Identity(), [term]))
        >>> weighted(0.1) == weighted(0.1), weighted(0.1) == weighted(0.2)
        (True, False)
    """
    return repr(_described(objective, set()))


def _described(value: Any, known: set[int]) -> Any:
    match value:
        case TensorDictBase():  # before modules: the parameters of a loss are both
            return {key: each.shape for key, each in value.items(True, True)}
        case Tensor():  # a constant, such as a bound
            return value.tolist()
        case dict():
            return {key: _described(each, known) for key, each in value.items()}
        case list() | tuple():
            return [_described(each, known) for each in value]
        case nn.Module() if id(value) not in known:
            known.add(id(value))
            own = {key: each for key, each in vars(value).items() if key not in _HOOKS}
            for kind in ("_parameters", "_buffers"):
                own[kind] = {key: getattr(each, "shape", None) for key, each in own[kind].items()}
            return type(value), _described(own, known)
    if isinstance(value, _CONSTANTS):
        return value
    own = vars(value) if hasattr(value, "__dict__") else {}
    return type(value), {key: each for key, each in own.items() if isinstance(each, _CONSTANTS)}
