"""The episodes to whose actions SAR is fitted."""

from __future__ import annotations

import pytest
import torch

from torchrl_etl.baselines import best_episodes


def kept(returns: list[float], **options: float) -> list[int]:
    return best_episodes(torch.tensor(returns), **options).nonzero().squeeze(-1).tolist()


def test_episodes_above_the_80th_percentile_by_hand() -> None:
    # Of returns 0, ..., 9 the 80th percentile is 7.2.
    assert kept([3.0, 9, 1, 0, 8, 5, 2, 7, 4, 6]) == [1, 4]


def test_an_episode_at_the_percentile_is_not_above_it() -> None:
    # Of returns 0, ..., 5 the 80th percentile is 4.
    assert kept([0.0, 1, 2, 3, 4, 5]) == [5]
    assert kept([1.0, 2.0, 3.0, 4.0], percentile=50) == [2, 3]


def test_highest_returns_are_taken_if_none_is_above_the_percentile() -> None:
    assert kept([1.0, 2, 2, 2]) == [1, 2, 3]


def test_returns_and_percentiles_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"returns has shape \[4, 2\]; it must be \[E\]"):
        best_episodes(torch.zeros(4, 2))
    with pytest.raises(ValueError, match=r"returns has shape \[0\]"):
        best_episodes(torch.zeros(0))
    with pytest.raises(ValueError, match="percentile is 101"):
        best_episodes(torch.zeros(4), percentile=101)
