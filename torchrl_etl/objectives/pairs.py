"""Helpers of losses on pairs of transitions: pairing samples and embedding their states."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_etl.draws import uniform_order
from torchrl_etl.objectives.checks import read

__all__ = ["embedded_ends", "outputs", "partners", "read_scalars", "target_params"]


def partners(
    samples: int, device: torch.device, pairs: Literal["permuted", "all"] = "permuted"
) -> Tensor:
    """Indices [samples, pairs per sample] of the samples that each one is compared with.

    Examples:
        >>> partners(3, torch.device("cpu"), "all")
        tensor([[1, 2],
                [2, 0],
                [0, 1]])
    """
    if samples < 2:
        raise ValueError("The batch holds one transition; distances need at least two.")
    if pairs == "all":
        index = torch.arange(samples, device=device)
        return (index.unsqueeze(1) + index[1:]) % samples
    # Neighbors on a random circle: a random permutation that maps no sample to itself.
    order = uniform_order(samples, device)
    return torch.zeros_like(order).scatter(0, order, order.roll(1)).unsqueeze(1)


def outputs(
    network: TensorDictModuleBase, params: TensorDictParams, tensordict: TensorDictBase
) -> Tensor:
    """A network's first output [samples, size] with these parameters."""
    with params.to_module(network, preserve_module_state=False):
        written = network(tensordict.select(*network.in_keys))
    return written.get(network.out_keys[0]).flatten(0, -2)


def read_scalars(
    loss: LossModule, following: TensorDictBase, key: NestedKey, samples: int
) -> Tensor:
    """An entry [*, 1] of the next states with a number for each of the ``samples``."""
    values = read(type(loss).__name__, following, key, "next")
    if values.shape[-1:] != (1,) or values.numel() != samples:
        raise ValueError(
            f"{type(loss).__name__}: the entry {unravel_key(('next', key))!r} has shape "
            f"{list(values.shape)}; it must be [*, 1], with one number for each of the {samples} "
            "embedded states."
        )
    return values


def target_params(loss: LossModule) -> TensorDictParams:
    """Parameters of a loss's target encoder, or of its encoder if it has no target.

    In the latter case TorchRL 0.14.1 returns ``data``, which cannot be read under ``vmap``.
    """
    has_target = loss._modules.get("target_encoder_params") is not None
    return loss.target_encoder_params if has_target else loss.encoder_params


def embedded_ends(loss: LossModule, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Embeddings [samples, k] of both ends; next states use the loss's target encoder.

    All terminated next states are one absorbing state, embedded at the origin.
    """
    embedding = outputs(loss.encoder, loss.encoder_params, tensordict)
    with torch.no_grad():
        following = tensordict["next"]
        next_embedding = outputs(loss.encoder, target_params(loss), following)
        ended = read_scalars(loss, following, loss.tensor_keys.terminated, len(embedding))
        return embedding, next_embedding.masked_fill(ended.reshape(-1, 1), 0.0)
