"""Transforms under VectorCollector against the same under TorchRL's Collector."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Categorical, Unbounded
from torchrl.envs import Compose, RewardSum, TransformedEnv
from torchrl.envs.transforms import Transform

from tests.both_collectors import PLAIN, assert_same, batches, parts
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.envs import make_env
from torchrl_etl.transforms import DirectionPrimer, LatentAction


def test_two_transforms_of_one_class_both_apply():
    make, policy = parts("overactuated", "explore")

    def twice() -> TransformedEnv:
        env = make().append_transform(DirectionPrimer(2, out_key="other"))
        return env.append_transform(RewardSum(["reward"], ["total"]))

    ours = batches(VectorCollector, twice, policy)
    assert_same(ours, batches(Collector, twice, policy, **PLAIN))
    written = ("direction", "other", "episode_reward", "total")
    assert all(batch["next", key].any() for batch in ours for key in written)


def latent_index(num_actions: int, **keys) -> LatentAction:
    """The policy picks a row of a table of ``num_actions`` actions of the overactuated task."""
    with torch.random.fork_rng():
        torch.manual_seed(2)
        table = nn.Embedding(num_actions, 16).requires_grad_(False)
    table.weight.clamp_(-1, 1)
    module = TensorDictModule(table, ["z"], ["action"])
    return LatentAction(module, Categorical(num_actions, shape=()), **keys)


@pytest.mark.parametrize("keys", [{}, {"latent_key": "action"}], ids=["latent", "action"])
def test_latent_action_equals_torchrls(keys):
    class Walk(nn.Module):
        """The next of three rows at each step, so that rows differ."""

        def forward(self, observation):
            return (observation[..., 0] * 1000).long().remainder(3)

    def make() -> TransformedEnv:
        env = make_env("overactuated", num_envs=3, seed=0)
        return TransformedEnv(env, Compose(latent_index(3, **keys), RewardSum()))

    policy = TensorDictModule(Walk(), ["observation"], [keys.get("latent_key", "latent")])
    ours = batches(VectorCollector, make, policy)
    assert_same(ours, batches(Collector, make, policy, **PLAIN))
    latent, decoded = ("action", "decoded_action") if keys else ("latent", "action")
    assert len(ours[0][latent].unique()) == 3 and ours[0]["next", "done"].any()
    assert torch.equal(ours[0][decoded], ours[0]["next", "executed_action"])


class Pays(Transform):
    """Writes an effort and multiplies the reward by ten for the transforms after it."""

    def __init__(self) -> None:
        super().__init__(in_keys=[], out_keys=["effort"])

    def _step(self, tensordict, next_tensordict):
        effort = next_tensordict["observation"][..., :1]
        return next_tensordict.update({"effort": effort, "reward": 10 * next_tensordict["reward"]})

    def transform_reward_spec(self, spec):
        spec["effort"] = Unbounded((3, 1))
        return spec

    def array_step(self, now, after):
        after["effort"] = after["observation"][..., :1]
        after["reward"] = 10 * after["reward"]

    def array_reset(self, now, fresh, done):
        """A reset writes no effort."""


def test_reward_sum_respects_its_keys_and_the_order_of_transforms():
    make, policy = parts("overactuated", "policy")

    def paid(*transforms: Transform) -> TransformedEnv:
        return TransformedEnv(make().base_env, Compose(*transforms))

    for order in (
        lambda: paid(Pays(), RewardSum(["effort", "reward"], ["efforts", "rewards"])),
        lambda: paid(RewardSum(), Pays()),
    ):
        ours = batches(VectorCollector, order, policy)
        assert_same(ours, batches(Collector, order, policy, **PLAIN))
