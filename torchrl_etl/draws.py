"""Random numbers of losses, which can be drawn beforehand.

Losses draw from this module. The numbers of many updates can thus be drawn at once, and learners
that are updated together each get numbers from their own generator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from threading import local
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = [
    "Draw",
    "drawn_in",
    "given_draws",
    "redrawn",
    "standard_normal",
    "standard_uniform",
    "uniform_order",
]

Draw = Callable[..., Tensor]
"""Draws one tensor; sizes as arguments add leading batch dimensions."""


class _Source(local):
    """Source of a thread's next numbers: a list of given tensors, or the generator."""

    given: list[Tensor] | None = None
    recorded: list[Draw] | None = None


_source = _Source()


def standard_normal(like: Tensor) -> Tensor:
    """Independent N(0, 1) samples in the shape of ``like``."""
    return _next(partial(_of_shape, torch.randn, like))


def standard_uniform(like: Tensor) -> Tensor:
    """Independent U(0, 1) samples in the shape of ``like``."""
    return _next(partial(_of_shape, torch.rand, like))


def uniform_order(count: int, device: torch.device) -> Tensor:
    """A uniformly random permutation of ``range(count)``."""
    return _next(lambda *sizes: torch.rand(*sizes, count, device=device).argsort(-1))


@contextmanager
def given_draws(tensors: Iterable[Tensor]) -> Iterator[None]:
    """Within the context, draws return ``tensors`` in order.

    Raises:
        IndexError: if more tensors are drawn than given.

    Examples:
        >>> with given_draws([torch.ones(2)]):
        ...     standard_normal(torch.zeros(2))
        tensor([1., 1.])
    """
    before, _source.given = _source.given, list(tensors)
    try:
        yield
    finally:
        _source.given = before


def drawn_in(draws: TensorDictBase | None) -> AbstractContextManager[None]:
    """Context in which losses take their random numbers from entries "0", "1", ... of ``draws``;
    with ``None``, from where they take them anyway."""
    if draws is None:
        return nullcontext()
    return given_draws(draws[f"{i}"] for i in range(len(draws.keys())))


def redrawn(function: Callable[..., Any]) -> Callable[..., list[Tensor]]:
    """A function that draws the random numbers of several calls of ``function`` at once.

    Which numbers ``function`` draws may depend only on the shapes of its arguments. The first call
    with new shapes runs ``function`` to record its draws, without advancing the generators.

    Examples:
        >>> draw = redrawn(lambda x: x + standard_normal(x))
        >>> [numbers.shape for numbers in draw(16, torch.zeros(2, 3))]
        [torch.Size([16, 2, 3])]
    """
    known: dict[tuple[torch.Size, ...], list[Draw]] = {}

    def draws(calls: int, *args: Any) -> list[Tensor]:
        shapes = tuple(each.shape for each in args)
        if shapes not in known:
            found = _source.recorded = []
            try:
                with torch.random.fork_rng(), torch.no_grad():
                    function(*args)
            finally:
                _source.recorded = None
            known[shapes] = found
        return [draw(calls) for draw in known[shapes]]

    return draws


def _of_shape(draw: Draw, like: Tensor, *sizes: int) -> Tensor:
    return draw(*sizes, *like.shape, dtype=like.dtype, device=like.device)


def _next(draw: Draw) -> Tensor:
    if _source.given is not None:
        return _source.given.pop(0)
    if _source.recorded is not None:
        _source.recorded.append(draw)
    return draw()
