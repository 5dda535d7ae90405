"""Lattice: exploration noise that is held for several steps."""

from __future__ import annotations

from copy import deepcopy
from itertools import pairwise
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.test_baselines_lattice import HIGH, LOW, SPEC, actor_on, observations
from torchrl_etl.baselines.lattice_noise import LatticeNoise
from torchrl_etl.collectors.policy_on_arrays import PolicyOnArrays
from torchrl_etl.modules import make_actor


def noisy(freq: int = 3, **kwargs: Any) -> LatticeNoise:
    return LatticeNoise(actor_on(state_dependent=True, **kwargs), freq=freq)


def same_rows(one: Tensor, other: Tensor) -> list[bool]:
    return [torch.equal(a, b) for a, b in zip(one, other, strict=True)]


def test_noise_over_many_draws_has_the_actors_distribution() -> None:
    policy = noisy(log_std_init=-0.5, std_reg=0.0, alpha=0.6)
    actor, one = policy.actor.double(), observations(1).double()
    rows = 40_000
    with torch.no_grad():
        action = policy(one.expand(rows).clone())["action"]
        dist = actor.get_dist(one)
    latent = ((action - LOW) / (HIGH - LOW) * 2 - 1).atanh()
    lower = dist.base_dist.scale_tril[0]
    torch.testing.assert_close(latent.T.cov(), lower @ lower.mT, rtol=0.05, atol=0.01)
    torch.testing.assert_close(latent.mean(0), dist.base_dist.loc[0], rtol=0, atol=0.03)


def test_noise_is_the_papers_function_of_the_features() -> None:
    policy, data = noisy(alpha=0.7), observations(2)
    with torch.no_grad():
        action = policy(data)["action"]
        latent, direct = policy._matrices
        network = policy.actor[0].module
        for row in range(2):
            x = network.features(data["observation"][row])
            value = network.mean(x + 0.7 * x @ latent[row]) + x @ direct[row]
            expected = LOW + (value.tanh() + 1) / 2 * (HIGH - LOW)
            torch.testing.assert_close(action[row], expected)


def test_rows_differ_and_keep_their_noise_for_freq_steps() -> None:
    policy, data = noisy(freq=3), observations(1).expand(4).clone()
    actions = [policy(data.clone())["action"] for _ in range(7)]
    assert not torch.equal(actions[0][0], actions[0][1])
    changes = [same_rows(*pair) for pair in pairwise(actions)]
    keep, change = [True] * 4, [False] * 4
    assert changes == [keep, keep, change, keep, keep, change]


def test_noise_is_redrawn_only_in_rows_whose_episode_begins() -> None:
    policy, data = noisy(freq=4), observations(3)
    policy.init_key = ("agent", "begins")
    first = policy(data.clone())["action"]
    begins = torch.tensor([[False], [True], [False]])
    second = policy(data.clone().set(("agent", "begins"), begins))["action"]
    assert same_rows(first, second) == [True, False, True]
    third, fourth, fifth = (policy(data.clone())["action"] for _ in range(3))
    assert same_rows(second, third) == [True] * 3 == same_rows(third, fourth)
    assert same_rows(fourth, fifth) == [False, True, False]  # the second row has a step left


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MEAN])
def test_no_noise_unless_exploring(kind: ExplorationType) -> None:
    policy, data = noisy(), observations(3)
    loud = policy(data.clone())["action"]
    with set_exploration_type(kind):
        silent = policy(data.clone())["action"]
    expected = policy.actor.get_dist(data.clone()).deterministic_sample
    torch.testing.assert_close(silent, expected)
    assert not torch.allclose(loud, silent)
    assert torch.equal(policy(data.clone())["action"], loud)  # the held noise is unchanged


def test_held_noise_replaces_the_actors_sample() -> None:
    policy, data = noisy(), observations(3)
    both = TensorDictSequential(policy.actor, policy)
    one, other = both(data.clone())["action"], both(data.clone())["action"]
    assert torch.equal(one, other)


def test_held_noise_is_not_written_saved_or_copied() -> None:
    policy, data = noisy(), observations(3)
    before = policy.state_dict().keys()
    written = policy(data.clone())
    assert set(written.keys()) == {"observation", "action"}
    assert policy.state_dict().keys() == before == {f"actor.{k}" for k in policy.actor.state_dict()}
    copy = deepcopy(policy)
    assert not torch.equal(copy(data.clone())["action"], written["action"])
    torch.testing.assert_close(copy.state_dict(), policy.state_dict())


@pytest.mark.parametrize("rows", [(), (3,), (2, 3)])
def test_batch_shape_and_dtype_may_change(rows: tuple[int, ...]) -> None:
    policy = noisy()
    assert policy(observations(7))["action"].shape == (7, 3)
    assert policy(observations(*rows))["action"].shape == (*rows, 3)
    assert policy.double()(observations(*rows).double())["action"].dtype == torch.float64


def test_held_noise_keeps_no_autograd_graph() -> None:
    policy = noisy()
    for _ in range(5):
        policy.zero_grad()
        policy(observations(2))["action"].sum().backward()
    assert not any(matrices.requires_grad for matrices in policy._matrices)


def test_wrong_actors_and_frequencies_are_refused() -> None:
    with pytest.raises(TypeError, match="state_dependent=True"):
        LatticeNoise(make_actor({"observation": 4}, SPEC))
    with pytest.raises(TypeError, match="does not depend on the state"):
        LatticeNoise(actor_on())
    with pytest.raises(ValueError, match="freq is 0"):
        noisy(freq=0)


@pytest.mark.parametrize("make", [actor_on, noisy])
def test_policy_on_arrays_matches_the_actor_and_explores(make: Any) -> None:
    policy, data = make(), observations(3)
    arrays = {"observation": data["observation"].numpy()}
    if "is_init" in policy.in_keys:
        arrays["is_init"] = torch.ones(3, 1, dtype=torch.bool).numpy()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = PolicyOnArrays(policy)(arrays)["action"]
        torch.testing.assert_close(torch.from_numpy(action), policy(data)["action"])
    with set_exploration_type(ExplorationType.RANDOM):
        on_arrays = PolicyOnArrays(policy)
        assert not (on_arrays(arrays)["action"] == on_arrays(arrays)["action"]).any()
