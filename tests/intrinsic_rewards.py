"""Encoders and transitions with known intrinsic rewards."""

from functools import partial

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from tests.point_env import OBSERVATION_DIM
from torchrl_etl.modules import StateEncoder

K = 2


def fixed_encoder(embedding_dim=K):
    """An encoder with the same weights in every process."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return StateEncoder(OBSERVATION_DIM, embedding_dim, hidden=(8,))


def doubler(size=1):
    """φ(s) = 2 s."""
    linear = nn.Linear(size, size, bias=False)
    linear.weight.data = 2 * torch.eye(size)
    return TensorDictModule(linear, in_keys=["observation"], out_keys=["embedding"])


def transitions(starts, ends, directions, rewards=None):
    """Transitions with one-dimensional observations and directions."""
    as_column = partial(torch.tensor, dtype=torch.float32)
    data = TensorDict(
        {
            "observation": as_column(starts)[..., None],
            "direction": as_column(directions)[..., None],
            "next": {"observation": as_column(ends)[..., None]},
        }
    ).auto_batch_size_(as_column(starts).ndim)
    if rewards is not None:
        data["next", "reward"] = as_column(rewards)[..., None]
    return data
