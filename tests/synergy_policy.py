"""A small policy with a synergy decoder, and checks that a batch is of its newest weights."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import BaseCollector

from torchrl_etl.envs import make_env
from torchrl_etl.modules import SynergyDecoder, make_actor

make_batched_env = partial(make_env, "overactuated", num_envs=2)


def synergy_policy() -> TensorDictSequential:
    """observation [6] → synergy [2] → action [16], for ``make_batched_env``."""
    torch.manual_seed(0)
    decoder = SynergyDecoder(2, 16, hidden=(8,))
    actor = make_actor({"observation": 6}, decoder.synergy_spec, out_key="synergy", hidden=(8,))
    return TensorDictSequential(actor, decoder)


def decode_to(policy: TensorDictSequential, value: float) -> torch.Tensor:
    """Make every action of the policy one constant, and return it."""
    _make_constant(policy[1], value)
    with torch.no_grad():
        return policy[1](TensorDict({"synergy": torch.zeros(2)}))["action"][0]


def act_around(policy: TensorDictSequential, value: float) -> None:
    """Make the actor write this number as ``loc``."""
    _make_constant(policy[0], value)


def _make_constant(module: torch.nn.Module, value: float) -> None:
    last = [layer for layer in module.modules() if isinstance(layer, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(value)


def was_decoded_by(batch: TensorDictBase, policy: TensorDictSequential) -> bool:
    with torch.no_grad():
        decoded = policy[1](batch.select("synergy").clone())["action"]
    return torch.allclose(batch["action"], decoded, atol=1e-6)


def assert_workers_differ(batch: TensorDictBase) -> None:
    """Two stacked workers start their episodes in different states and draw different noise."""
    first, second = batch["observation"][:, :, 0]
    assert not torch.isclose(first[:, :2], second[:, :2]).any()
    noise = (batch["synergy"][:, :, 0].atanh() - batch["loc"][:, :, 0]) / batch["scale"][:, :, 0]
    assert not torch.isclose(noise[0], noise[1], atol=1e-3).any()


def assert_each_push_is_in_the_next_batch(
    collector: BaseCollector, policy: TensorDictSequential, batches: Iterator[TensorDictBase]
) -> None:
    for version in (1, 2):
        action = decode_to(policy, 0.3 * version)
        act_around(policy, version)
        collector.update_policy_weights_()
        batch = next(batches)
        assert torch.allclose(batch["action"], action.expand_as(batch["action"]))
        assert was_decoded_by(batch, policy)
        assert (batch["loc"] == version).all()
        assert origin(batch, "policy_version") == version


def distinct_frames(batches: list[TensorDictBase]) -> int:
    """The number of distinct frames: noise makes frames equal only if delivered twice."""
    frames = torch.cat([batch.reshape(-1) for batch in batches])
    return len(torch.cat([frames["observation"], frames["synergy"]], -1).unique(dim=0))


def origin(batch: TensorDictBase, key: str) -> int:
    (value,) = batch["collector", key].unique().tolist()
    return value
