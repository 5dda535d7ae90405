"""HeldNoise: the distribution of the actor at every step, held for a zeta-distributed time."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import kstest
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, TruncatedNormal

from torchrl_etl.modules import HeldNoise, make_actor

ROWS = 2000


def policy(**kwargs) -> HeldNoise:
    actor = make_actor({"observation": 3}, Bounded(0, 1, shape=(2,)), hidden=(8,))
    return HeldNoise(actor, **kwargs)


def step(policy: HeldNoise, begins: bool | torch.Tensor = False, rows: int = ROWS) -> torch.Tensor:
    entries = {
        "observation": torch.ones(rows, 3),
        "is_init": torch.as_tensor(begins).expand(rows, 1) if isinstance(begins, bool) else begins,
    }
    with torch.no_grad():
        return policy(TensorDict(entries, [rows]))["action"]


def test_held_noise_has_the_actors_distribution():
    held = policy()
    for _ in range(5):
        action = step(held)
    entries = TensorDict({"observation": torch.ones(1, 3)}, [1])
    distribution = held.actor.get_dist(entries)
    before_tanh = torch.atanh(2 * action - 1)
    standard = (before_tanh - distribution.loc) / distribution.scale
    assert kstest(standard.detach()[:, 0], "norm").pvalue > 0.01
    correlation = standard.mT.corrcoef()[0, 1]  # between the two actuators
    assert correlation.abs() < 3 / ROWS**0.5


def test_durations_follow_the_truncated_zeta_distribution():
    held, longest = policy(longest=3, exponent=1.0), 3
    first = step(held, True)
    lasts = torch.ones(ROWS, dtype=torch.long)
    same = torch.ones(ROWS, dtype=torch.bool)
    for _ in range(longest):
        same &= (step(held) == first).all(-1)
        lasts += same
    weights = torch.tensor([1.0, 1 / 2, 1 / 3])
    shares = lasts.bincount(minlength=5)[1:4] / ROWS
    torch.testing.assert_close(shares, weights / weights.sum(), atol=0.04, rtol=0)
    assert lasts.max() == longest


def test_an_episode_begins_with_fresh_noise_and_rows_are_independent():
    held = policy(longest=1_000_000, exponent=0.01)  # practically never redrawn within an episode
    first = step(held, True, rows=4)
    begins = torch.tensor([[True], [False], [False], [True]])
    second = step(held, begins, rows=4)
    assert (first[1:3] == second[1:3]).all() and (first[[0, 3]] != second[[0, 3]]).all()
    assert first.unique(dim=0).shape[0] == 4


def test_without_random_exploration_actions_are_the_actors():
    held = policy()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = step(held, rows=3)
        entries = TensorDict({"observation": torch.ones(3, 3)}, [3])
        torch.testing.assert_close(action, held.actor(entries)["action"])


def test_state_dict_excludes_the_held_noise():
    held = policy()
    keys = set(held.state_dict())
    step(held, True)
    assert set(held.state_dict()) == keys


def actor_of(kind: type) -> ProbabilisticActor:
    network = nn.Sequential(nn.Linear(3, 4), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=kind,
        return_log_prob=True,
    )


@pytest.mark.parametrize("kind", [IndependentNormal, TruncatedNormal])
def test_an_actor_without_a_tanh_gaussian_is_refused(kind: type):
    with pytest.raises(ValueError, match=f"samples from {kind.__name__}; held noise needs a Tanh"):
        HeldNoise(actor_of(kind))


def test_out_keys_are_the_written_entries():
    held = HeldNoise(actor_of(TanhNormal))
    data = TensorDict({"observation": torch.ones(2, 3), "is_init": torch.ones(2, 1).bool()}, [2])
    assert set(held.out_keys) == set(held(data.clone()).keys()) - set(data.keys())


def test_data_without_is_init_are_refused():
    with pytest.raises(KeyError, match=r"'is_init', which the data lacks.* an InitTracker\(\)"):
        policy()(TensorDict({"observation": torch.ones(2, 3)}, [2]))
