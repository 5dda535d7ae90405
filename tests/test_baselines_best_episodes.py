"""The episodes whose actions SAR is fitted to."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_etl.baselines import best_episodes


def rows_of(returns: list[float], steps: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Actions equal to their episode's number, their returns and the episode numbers."""
    episodes = torch.arange(len(returns)).repeat_interleave(torch.tensor(steps))
    return episodes.float().unsqueeze(-1), torch.tensor(returns)[episodes], episodes


def test_episodes_above_the_80th_percentile_by_hand() -> None:
    # Of returns 0, ..., 9 the 80th percentile is 7.2.
    actions, returns, _ = rows_of([3.0, 9, 1, 0, 8, 5, 2, 7, 4, 6], [2] * 10)
    shuffled = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    kept = best_episodes(actions[shuffled], returns[shuffled])
    assert sorted(kept.squeeze(-1).tolist()) == [1, 1, 4, 4]


def test_an_episode_at_the_percentile_is_not_above_it() -> None:
    # Of returns 0, ..., 5 the 80th percentile is 4.
    actions, returns, _ = rows_of([0.0, 1, 2, 3, 4, 5], [3] * 6)
    assert best_episodes(actions, returns).unique().tolist() == [5]


def test_percentile_is_over_episodes_when_their_numbers_are_given() -> None:
    # By steps the median is 3, the return of the longest; by episodes it is 2.5.
    actions, returns, episodes = rows_of([1.0, 2.0, 3.0, 4.0], [1, 1, 20, 1])
    assert best_episodes(actions, returns, percentile=50).unique().tolist() == [3]
    kept = best_episodes(actions, returns, episodes=episodes, percentile=50)
    assert kept.unique().tolist() == [2, 3]


def test_highest_returns_are_taken_if_none_is_above_the_percentile() -> None:
    actions, returns, _ = rows_of([1.0, 2, 2, 2], [2] * 4)
    assert best_episodes(actions, returns).unique().tolist() == [1, 2, 3]


def test_rows_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"actions has shape \[4, 2\], returns \[3\]"):
        best_episodes(torch.zeros(4, 2), torch.zeros(3))
    with pytest.raises(ValueError, match="percentile is 101"):
        best_episodes(torch.zeros(4, 2), torch.zeros(4), percentile=101)
    with pytest.raises(ValueError, match="returns differ within an episode"):
        best_episodes(torch.zeros(2, 1), torch.tensor([1.0, 2.0]), episodes=torch.zeros(2))
