"""Lookup tables as networks, and transitions between their rows, for losses by hand."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn


class Lookup(nn.Module):
    """Maps the one-hot observation i to row i."""

    def __init__(self, rows: list[list[float]]) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.tensor(rows))

    def forward(self, observation: Tensor, *_: Tensor) -> Tensor:
        return observation @ self.rows


def table(*rows: list[float]) -> TensorDictModule:
    """An encoder that maps state i to row i."""
    return TensorDictModule(Lookup(list(rows)), in_keys=["observation"], out_keys=["embedding"])


def steps(states: list[int], following: list[int], num: int, **entries: Tensor) -> TensorDict:
    """Steps between ``num`` one-hot states, with further entries at the root."""
    one_hot, size = torch.eye(num), [len(states)]
    following = TensorDict({"observation": one_hot[following]}, size)
    return TensorDict({"observation": one_hot[states], "next": following, **entries}, size)


def transitions(
    states: list[int], following: list[int], rewards: list[float], ended: list[bool], num: int
) -> TensorDict:
    """Steps with rewards, terminations, and an action of zero."""
    data = steps(states, following, num, action=torch.zeros(len(states), 1))
    data["next", "reward"] = torch.tensor(rewards).unsqueeze(-1)
    data["next", "terminated"] = torch.tensor(ended).unsqueeze(-1)
    return data
