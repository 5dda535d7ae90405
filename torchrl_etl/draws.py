"""Random numbers of losses, which can be drawn beforehand.

A loss takes its random numbers from here, so that those of many updates are drawn in one go, and
several learners that are updated as one are each given what its own generator draws.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from threading import local
from typing import Any

import torch
from torch import Tensor

__all__ = [
    "Draw",
    "given_draws",
    "redrawn",
    "standard_normal",
    "standard_uniform",
    "uniform_order",
]

Draw = Callable[..., Tensor]
"""Draws one of a kind, or with sizes as arguments an array of so many."""


class _Source(local):
    """Where a thread's next numbers come from: a list of what is given, or the generator."""

    given: list[Tensor] | None = None
    recorded: list[Draw] | None = None


_source = _Source()


def standard_normal(like: Tensor) -> Tensor:
    """Independent N(0, 1) numbers of the shape of ``like``."""
    return _next(partial(_of_shape, torch.randn, like))


def standard_uniform(like: Tensor) -> Tensor:
    """Independent U(0, 1) numbers of the shape of ``like``."""
    return _next(partial(_of_shape, torch.rand, like))


def uniform_order(count: int, device: torch.device) -> Tensor:
    """A permutation of ``range(count)``, each as likely as any other."""
    return _next(lambda *sizes: torch.rand(*sizes, count, device=device).argsort(-1))


@contextmanager
def given_draws(tensors: Iterable[Tensor]) -> Iterator[None]:
    """What is drawn within is taken from ``tensors``, one after another.

    Raises:
        IndexError: where more is drawn than was given.

    Examples:
        >>> with given_draws([torch.ones(2)]):
        ...     standard_normal(torch.zeros(2))
        tensor([1., 1.])
    """
    _source.given = list(tensors)
    try:
        yield
    finally:
        _source.given = None


def redrawn(function: Callable[..., Any]) -> Callable[..., list[Tensor]]:
    """Draws what ``function`` would in so many calls, from the generators as they are.

    What that is, which must be the same for all arguments of a shape, is found out by the first
    call with it, which runs ``function``.

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
