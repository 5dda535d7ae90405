"""Networks that are lookup tables, and transitions between their rows: numbers by hand."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn


class Lookup(nn.Module):
    """Observation i, one-hot, gives row i."""

    def __init__(self, rows: list[list[float]]) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.tensor(rows))

    def forward(self, observation: Tensor, *_: Tensor) -> Tensor:
        return observation @ self.rows


def table(*rows: list[float]) -> TensorDictModule:
    """Embeddings of as many states."""
    return TensorDictModule(Lookup(list(rows)), in_keys=["observation"], out_keys=["embedding"])


def steps(states: list[int], following: list[int], num: int, **entries: Tensor) -> TensorDict:
    """Steps from states to others of ``num``, with more entries at the root."""
    one_hot, size = torch.eye(num), [len(states)]
    following = TensorDict({"observation": one_hot[following]}, size)
    return TensorDict({"observation": one_hot[states], "next": following, **entries}, size)


def transitions(
    states: list[int], following: list[int], rewards: list[float], ended: list[bool], num: int
) -> TensorDict:
    """Steps with the task's rewards and ends, and an action that means nothing."""
    data = steps(states, following, num, action=torch.zeros(len(states), 1))
    data["next", "reward"] = torch.tensor(rewards).unsqueeze(-1)
    data["next", "terminated"] = torch.tensor(ended).unsqueeze(-1)
    return data
