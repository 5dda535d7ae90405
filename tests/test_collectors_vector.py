"""VectorCollector against TorchRL's Collector, transition by transition."""

from __future__ import annotations

import warnings

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, ListStorage, ReplayBuffer, Unbounded
from torchrl.envs import (
    ExplorationType,
    GymWrapper,
    RewardSum,
    StepCounter,
    TransformedEnv,
    default_info_dict_reader,
    set_exploration_type,
)

from tests.both_collectors import PLAIN, assert_same, batches, parts, tracked
from tests.frozen_by_a_graph import CHANGES, MAKERS
from tests.point_env import ACTION_DIM, OBSERVATION_DIM, vectorized_point
from torchrl_etl.baselines.dynsyn import make_dynsyn_actor
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.envs import make_env
from torchrl_etl.modules import HeldNoise
from torchrl_etl.transforms import LatentAction


@pytest.mark.parametrize("mode", ["explore", "policy", "transform"])
@pytest.mark.parametrize("name", ["overactuated", "InvertedPendulum-v5"])
def test_transitions_equal_torchrls_bit_for_bit(name, mode):
    make, policy = parts(name, mode)
    ours = batches(VectorCollector, make, policy)
    theirs = batches(Collector, make, policy, **PLAIN)
    assert_same(ours, theirs)
    ended = "terminated" if name == "InvertedPendulum-v5" else "truncated"
    assert sum(batch["next", ended].sum() for batch in ours) > 2
    if name == "overactuated":
        assert not any(batch["next", "terminated"].any() for batch in ours)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["myoHandPenTwirl", "dog-run"])
def test_transitions_of_real_simulators_equal_torchrls(name):
    make, policy = parts(name, "explore", num_envs=2)
    assert_same(
        batches(VectorCollector, make, policy, frames=120),
        batches(Collector, make, policy, frames=120, **PLAIN),
    )


def test_held_noise_equals_torchrls_and_is_init_follows_done():
    _, policy = parts("overactuated", "policy")

    held = TensorDictSequential(HeldNoise(policy[0]), policy[1])
    ours = batches(VectorCollector, tracked, held)
    held = TensorDictSequential(HeldNoise(policy[0]), policy[1])
    assert_same(ours, batches(Collector, tracked, held, **PLAIN))
    begins = torch.cat([batch["is_init"] for batch in ours], dim=1)
    ends = torch.cat([batch["next", "done"] for batch in ours], dim=1)
    assert begins[:, 0].all() and torch.equal(begins[:, 1:], ends[:, :-1]) and ends.any()


def test_partial_resets_equal_torchrls():
    def make():
        return TransformedEnv(vectorized_point(), RewardSum())

    policy = TensorDictModule(
        nn.Linear(OBSERVATION_DIM, ACTION_DIM), in_keys=["observation"], out_keys=["action"]
    )
    ours = batches(VectorCollector, make, policy, frames=24)
    assert_same(ours, batches(Collector, make, policy, frames=24, **PLAIN))
    assert ours[0]["next", "done"].sum(1).flatten().tolist() == [4, 2, 2]  # of 2, 3, 4 steps


def batches_of_both_collectors(make_policy, change=lambda _: None):
    """Batches of VectorCollector and of Collector, each with its own copy of the policy."""
    found = []
    for kind, options in ((VectorCollector, {}), (Collector, PLAIN)):
        torch.manual_seed(0)
        found.append(batches(kind, tracked, make_policy(), change=change, **options))
    return found


@pytest.mark.parametrize("name", MAKERS)
def test_policy_that_cannot_be_traced_acts_as_under_torchrl(name):
    assert_same(*batches_of_both_collectors(MAKERS[name]))


@pytest.mark.parametrize("name", CHANGES)
def test_change_of_the_policy_between_batches_takes_effect(name):
    ours, theirs = batches_of_both_collectors(*CHANGES[name])
    assert_same(ours, theirs)
    assert not torch.equal(ours[0]["action"], ours[1]["action"])


def test_without_a_policy_actions_are_random_as_under_torchrl():
    ours, theirs = batches_of_both_collectors(lambda: None)
    assert_same(ours, theirs)
    assert ours[0]["action"].std() > 0.3


@pytest.mark.parametrize("mode", ["explore", "policy", "transform"])
def test_package_policies_are_traced_once_without_warnings(mode):
    make, policy = parts("overactuated", mode)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        collector = VectorCollector(make, policy, frames_per_batch=12, total_frames=-1)
    graphs = set()
    for _, _ in zip(range(3), collector, strict=False):
        graphs.add(collector._policy_on_arrays._graph)
        with torch.no_grad():
            for weight in policy.parameters():
                weight.mul_(0.9)
        policy.train(False).train(True)
    assert len(graphs) == 1 and None not in graphs
    collector.shutdown()


def test_untraceable_policy_warns_with_the_reason():
    with pytest.warns(UserWarning, match=r"a graph may miss what Odd does \(hooks, branches"):
        VectorCollector(tracked, MAKERS["Python in forward"](), frames_per_batch=12).shutdown()


def test_policy_with_an_overridden_forward_acts_as_under_torchrl():
    class Doubled(TensorDictModule):
        def forward(self, tensordict):
            out = super().forward(tensordict)
            return out.set("action", out["action"].clamp(-0.5, 0.5))

    make, _ = parts("overactuated", "policy")
    policy = Doubled(nn.Linear(6, 16), in_keys=["observation"], out_keys=["action"])
    ours = batches(VectorCollector, make, policy)
    assert_same(ours, batches(Collector, make, policy, **PLAIN))
    assert ours[0]["action"].abs().max() <= 0.5


def test_collection_and_process_rngs_do_not_affect_each_other():
    make, policy = parts("overactuated", "explore")
    collector = VectorCollector(make, policy, frames_per_batch=96, total_frames=-1)
    iterator = iter(collector)

    def collected(disturbance: int):
        collector.set_seed(3)
        collector.reset()
        out = []
        for _ in range(2):
            torch.manual_seed(disturbance)
            before = torch.get_rng_state()
            out.append(next(iterator).clone())
            assert torch.equal(torch.get_rng_state(), before)
        return torch.stack(out).exclude(("collector", "traj_ids"))

    assert (collected(1) == collected(2)).all()
    collector.shutdown()


def test_weights_changed_in_place_or_replaced_take_effect():
    make, policy = parts("overactuated", "policy")
    last = policy.module[1].module.decoder.mlp[-1]
    collector = VectorCollector(make, policy, frames_per_batch=12, total_frames=-1)
    iterator = iter(collector)

    def action() -> torch.Tensor:
        return next(iterator)["action"].unique()

    assert len(action()) > 1
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(20.0)
    assert action().tolist() == [1.0]
    last.bias = nn.Parameter(torch.full_like(last.bias, -20.0))
    assert action().tolist() == [-1.0]
    collector.shutdown()


def test_the_exploration_type_is_obeyed():
    make, policy = parts("overactuated", "explore")
    collector = VectorCollector(
        make,
        policy,
        frames_per_batch=96,
        total_frames=-1,
        exploration_type=ExplorationType.DETERMINISTIC,
    )
    batch = next(iter(collector))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = policy(batch.select("observation", "direction"))["action"]
    torch.testing.assert_close(batch["action"], expected)
    collector.shutdown()


def test_init_random_frames_are_collected_first():
    make, policy = parts("overactuated", "policy")
    with torch.no_grad():
        policy.module[1].module.decoder.mlp[-1].bias.fill_(20.0)
    collector = VectorCollector(
        make, policy, frames_per_batch=48, total_frames=96, init_random_frames=48
    )
    first, second = collector
    assert first["action"].std() > 0.3
    assert second["action"].min() > 0.9


def test_episodes_end_without_trajectory_numbers():
    make, policy = parts("overactuated", "policy")
    collector = VectorCollector(make, policy, frames_per_batch=96, track_traj_ids=False)
    batch = next(iter(collector))
    assert batch["next", "done"].any()
    assert "collector" not in batch


@pytest.mark.parametrize(
    "name, value",
    [
        ("replay_buffer", ReplayBuffer(storage=ListStorage(10))),
        ("max_frames_per_traj", 5),
        ("track_policy_version", True),
        ("compact_obs", True),
    ],
)
def test_unsupported_arguments_are_refused_by_name(name, value):
    make, policy = parts("overactuated", "policy")
    with pytest.raises(ValueError, match=f"takes no {name}; leave it out, or use torchrl"):
        VectorCollector(make, policy, frames_per_batch=12, **{name: value})


def twice_decoded() -> TransformedEnv:
    make, _ = parts("overactuated", "transform")
    module = TensorDictModule(nn.Linear(2, 2), ["z"], ["synergy"])
    outer = LatentAction(module, Bounded(-1, 1, shape=(2,)), executed_key="executed_synergy")
    return make().append_transform(outer)


def test_unsupported_environments_are_refused():
    make, policy = parts("overactuated", "policy")
    with pytest.raises(ValueError, match="has SynergyAction and LatentAction, and VectorColl"):
        VectorCollector(twice_decoded, policy, frames_per_batch=12)
    with pytest.raises(ValueError, match="has a StepCounter; use"):
        VectorCollector(lambda: make().append_transform(StepCounter()), policy, frames_per_batch=12)
    with pytest.raises(ValueError, match="num_envs=2 or more"):
        VectorCollector(lambda: make_env("overactuated"), policy, frames_per_batch=12)
    simulators = vectorized_point()._env
    with pytest.raises(ValueError, match="skips frame_skip and readers of info"):
        VectorCollector(GymWrapper(simulators, frame_skip=2), frames_per_batch=12)
    reader = default_info_dict_reader(["age"], spec=[Unbounded((3,))])
    with pytest.raises(ValueError, match="skips frame_skip and readers of info"):
        VectorCollector(GymWrapper(simulators).set_info_dict_reader(reader), frames_per_batch=12)


@pytest.mark.parametrize("kind", [VectorCollector, Collector])
def test_reset_keeps_the_buffers_of_the_policy(kind):
    env = make_env("overactuated", num_envs=2, seed=0)
    spec = env.full_action_spec_unbatched["action"]
    actor = make_dynsyn_actor({"observation": 6}, spec, [0, 1, 2, 3] * 4, hidden=(8,))
    collector = kind(env, actor, frames_per_batch=8, total_frames=-1)
    before = [buffer.clone() for buffer in actor.buffers()]
    next(iter(collector))
    collector.reset()
    assert all(map(torch.equal, before, actor.buffers()))
    collector.shutdown()
