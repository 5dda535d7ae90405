"""The reward ensemble and the scale from the variance of its members."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_etl.baselines.reward_ensemble import RewardEnsemble, diversity_scale


def test_members_start_with_different_predictions() -> None:
    ensemble = RewardEnsemble(3, 2, 5)
    data = TensorDict({"observation": torch.randn(4, 3), "action": torch.randn(4, 2)}, [4])
    predictions = ensemble(data)["reward_prediction"]
    assert predictions.shape == (4, 5)
    assert (predictions.var(-1) > 0).all()


@pytest.mark.parametrize(
    ("predictions", "scale"),
    [([0.0, 1.0], 1.0), ([2.0, 2.0], 1.0), ([0.0, 4.0], 4.0), ([0.0, 10.0], 10.0), ([3.0], 1.0)],
)
def test_diversity_scale_is_the_variance_clamped_to_its_bounds(
    predictions: list[float], scale: float
) -> None:
    assert diversity_scale(torch.tensor(predictions)).tolist() == [scale]


def test_an_ensemble_without_members_is_refused() -> None:
    with pytest.raises(ValueError, match="size is 0"):
        RewardEnsemble(3, 2, 0)
