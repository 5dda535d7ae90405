"""Theorem 1, measured: the fixed point of the metric, its collapse without reward, and the hinge.

The chain is a deterministic cycle with a uniform stationary distribution. Two states at some lag
are followed by two states at the same lag, so pairs and their successors have the same
distribution, as Eq. 4 assumes.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_etl.functional import expected_distance, l2_distance, metric_target
from torchrl_etl.modules import GaussianDynamics, StateEncoder
from torchrl_etl.objectives import BehavioralMetricLoss

STATES, GAMMA = 6, 0.8
# With one rewarded state the metric is d(i, j) = u(i) + u(j), a star, which embeds into Euclidean
# space without distortion. (Most reward patterns give metrics without an L2 embedding.)
SPARSE = torch.eye(STATES)[0]
OTHERS = ~torch.eye(STATES, dtype=torch.bool)


def cycle(reward: Tensor) -> TensorDict:
    one_hot = torch.eye(STATES)
    return TensorDict(
        {
            "observation": one_hot,
            "next": {
                "observation": one_hot.roll(-1, 0),
                "reward": reward.unsqueeze(-1),
                "terminated": torch.zeros(STATES, 1, dtype=torch.bool),
            },
        },
        [STATES],
    )


def fixed_point(reward: Tensor) -> Tensor:
    """Eq. 2, iterated on a table until it converges."""
    distance = torch.zeros(STATES, STATES)
    for _ in range(200):
        following = distance.roll((-1, -1), (0, 1))
        distance = metric_target(reward.unsqueeze(1), reward, following, GAMMA)
    return distance


def trained_distances(
    reward: Tensor, steps: int, rate: float = 2e-3, *, seed: int = 0, **options: Any
) -> Tensor:
    torch.manual_seed(seed)
    encoder = StateEncoder(STATES, STATES, hidden=(64, 64))
    latent_model = (
        GaussianDynamics(STATES, hidden=(256,)) if options.get("divergence") == "gaussian" else None
    )
    loss = BehavioralMetricLoss(encoder, latent_model, pairs="all", gamma=GAMMA, **options)
    updater = SoftUpdate(loss, tau=0.05)
    optimizer = torch.optim.Adam(loss.parameters(), rate)
    data = cycle(reward)
    for _ in range(steps):
        out = loss(data)
        optimizer.zero_grad()
        sum(value for key, value in out.items() if key.startswith("loss_")).backward()
        optimizer.step()
        updater.step()
    with torch.no_grad():
        embedding = encoder(data.select("observation"))["embedding"]
    return l2_distance(embedding.unsqueeze(1), embedding)


def test_the_fixed_point_has_the_mean_of_equation_4() -> None:
    difference = (SPARSE.unsqueeze(1) - SPARSE).abs()[OTHERS].mean()
    mean = fixed_point(SPARSE)[OTHERS].mean()
    torch.testing.assert_close(mean, expected_distance(difference, GAMMA))


def test_learned_distances_reach_the_fixed_point_and_its_mean() -> None:
    learned, exact = trained_distances(SPARSE, 800, regularizer="none"), fixed_point(SPARSE)
    difference = (SPARSE.unsqueeze(1) - SPARSE).abs()[OTHERS].mean()
    predicted = expected_distance(difference, GAMMA)
    assert learned[OTHERS].mean().item() == pytest.approx(predicted.item(), rel=0.03)
    # Not only on average, but for every pair.
    assert (learned - exact)[OTHERS].abs().max() < 0.1 * exact.max()


def test_gaussian_divergence_approaches_the_same_mean() -> None:
    options = {"divergence": "gaussian", "regularizer": "none"}
    found = [
        trained_distances(SPARSE, 1500, 7e-4, seed=seed, **options)[OTHERS].mean()
        for seed in range(3)
    ]
    predicted = fixed_point(SPARSE)[OTHERS].mean()
    # The mean is lower than predicted while two states coincide. Whether they do depends on
    # rounding, and so on the number of threads: hence the median of three seeds.
    assert max(found) < 1.05 * predicted
    assert sorted(found)[1] > 0.8 * predicted


def test_plain_and_literal_metrics_collapse_without_reward() -> None:
    silent = torch.zeros(STATES)
    for regularizer in ("none", "literal"):
        learned = trained_distances(silent, 600, regularizer=regularizer, weight=1.0)
        assert learned[OTHERS].mean() < 0.02, regularizer


def test_hinge_keeps_states_apart_without_reward() -> None:
    learned = trained_distances(torch.zeros(STATES), 500)
    # Metric and hinge balance at (1 - gamma) d = 2 lambda (m - d), with lambda 0.1 and m 1.
    balance = 2 * 0.1 / (1 - GAMMA + 2 * 0.1)
    assert learned[OTHERS].mean().item() == pytest.approx(balance, rel=0.1)
    assert learned[OTHERS].min() > 0.5 * balance
