"""Lower bound for the time of an update: its matrix products only.

These are exactly the products of an update, on separate tensors, without unneeded gradients. They
use the same operation as compiled updates: ``torch.mm`` or oneDNN's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchrl_etl.learners.products import by_onednn, faster_products, multiply

__all__ = ["floor", "products", "sac_products", "stage_products"]

Shape = tuple[int, int, int]
"""Rows, inner dimension and columns of a product."""


def products(batch: int, widths: list[int], passes: str) -> Iterator[Shape]:
    """Products in the passes of an MLP.

    ``f``: forward; ``w``: gradient of the weights; ``h``: gradient of the hidden activations;
    ``i``: gradient of hidden activations and the input.
    """
    layers = list(pairwise(widths))
    for kind in passes:
        for index, (wide, narrow) in enumerate(layers):
            if kind == "f":
                yield batch, wide, narrow
            elif kind == "w":
                yield wide, batch, narrow
            elif kind == "i" or index:
                yield batch, narrow, wide


def sac_products(batch: int, inputs: int, action: int, out: int, hidden: list[int]) -> list[Shape]:
    """Products of twin critics on ``inputs`` + ``action``, and an actor with ``out`` outputs."""
    critic = [inputs + action, *hidden, 1]
    shapes = list(products(batch, [inputs, *hidden, 2 * out], "ffwh"))
    for _ in range(2):
        shapes += products(batch, critic, "ffwhfh")  # target, regression, actor loss
        shapes.append((batch, hidden[0], action))  # input gradient for the action only
    return shapes


def stage_products(cfg: Any, name: str, observation_dim: int, action_dim: int) -> list[Shape]:
    d, batch, hidden = cfg.num_synergies, cfg[name].batch_size, list(cfg.actor.hidden)
    body = list(cfg.synergies.hidden)
    decoder = [d, *reversed(body), action_dim]
    if name == "learn":
        shapes = sac_products(batch, observation_dim, action_dim, d, hidden)
        return shapes + list(products(batch, decoder, "ffwifwh"))  # s', s, Eq. 10
    shapes = sac_products(batch, observation_dim + d, action_dim, action_dim, hidden)
    shapes += products(batch, [observation_dim, *cfg.exploration.encoder.hidden, d], "fwhff")
    shapes += products(batch, [action_dim, *body, d * (1 + 2 * d)], "fwh")
    return shapes + list(products(d * batch, decoder, "fwi"))


def floor(shapes: list[Shape]) -> Callable[[], object]:
    calls = [product(torch.randn(m, k), torch.randn(k, n)) for m, k, n in shapes]

    def run() -> None:
        for call in calls:
            call()

    return run


def product(left: Tensor, right: Tensor) -> Callable[[], Tensor]:
    if faster_products() and by_onednn(left, right):
        return partial(multiply, left, right, None)
    return partial(torch.mm, left, right, out=torch.empty(len(left), right.shape[1]))
