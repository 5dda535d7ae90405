"""The same collection by VectorCollector and by TorchRL's Collector."""

from __future__ import annotations

from functools import partial

import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs import Compose, InitTracker, RewardSum, TransformedEnv

from torchrl_etl.envs import make_env
from torchrl_etl.modules import SynergyDecoder, make_actor
from torchrl_etl.transforms import DirectionPrimer, SynergyAction

PLAIN = {"trust_policy": True, "auto_register_policy_transforms": False}


def parts(name: str, mode: str, num_envs: int = 3, **kwargs):
    """A function that makes the environment of a stage, and a policy for it."""
    make = partial(make_env, name, num_envs=num_envs, **kwargs)
    env = make()
    spec = env.full_action_spec_unbatched["action"]
    observation = {"observation": env.observation_spec["observation"].shape[-1]}
    env.close()
    torch.manual_seed(0)
    if mode == "explore":
        actor = make_actor({**observation, "direction": 4}, spec, hidden=(32, 32))
        return lambda: TransformedEnv(make(), RewardSum()).append_transform(
            DirectionPrimer(4)
        ), actor
    num_synergies = min(2, spec.shape[0])
    decoder = SynergyDecoder(
        num_synergies, spec.shape[0], low=spec.space.low, high=spec.space.high, hidden=(16,)
    )
    with torch.no_grad():
        decoder.module.scale.fill_(5.0)  # so that actions differ
    actor = make_actor(observation, decoder.synergy_spec, out_key="synergy", hidden=(32, 32))
    if mode == "policy":
        return lambda: TransformedEnv(make(), RewardSum()), TensorDictSequential(actor, decoder)
    return lambda: TransformedEnv(make(), RewardSum()).append_transform(
        SynergyAction(decoder)
    ), actor


def tracked() -> TransformedEnv:
    return TransformedEnv(
        make_env("overactuated", num_envs=3, seed=0), Compose(RewardSum(), InitTracker())
    )


def batches(
    collector_class, make, policy, count: int = 3, frames: int = 96, change=lambda _: None, **kwargs
):
    collector = collector_class(make, policy, frames_per_batch=frames, total_frames=-1, **kwargs)
    collector.set_seed(7)
    torch.manual_seed(7)
    collector.reset()
    iterator = iter(collector)
    found = []
    for _ in range(count):
        found.append(next(iterator).clone())
        change(policy)
    collector.shutdown()
    return found


def assert_same(ours, theirs) -> None:
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.batch_size == other.batch_size and mine.names == other.names
        assert set(mine.keys(True, True)) == set(other.keys(True, True))
        for key in other.keys(True, True):
            assert mine[key].dtype == other[key].dtype, key
            assert torch.equal(mine[key], other[key]), key
