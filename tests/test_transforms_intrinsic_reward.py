"""IntrinsicReward: the checks of a transform, its values, and refused arguments."""

import copy
import io

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, MultiStep, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    ParallelEnv,
    RenameTransform,
    RewardScaling,
    SerialEnv,
    TransformedEnv,
    VecNormV2,
)
from torchrl.envs.transforms import RNDTransform
from torchrl.envs.utils import check_env_specs

from tests.intrinsic_rewards import K, doubler, fixed_encoder, transitions
from tests.point_env import HORIZON, OBSERVATION_DIM, PointEnv, TeamEnv
from tests.transform_checks import TransformChecks
from torchrl_etl.transforms import DirectionPrimer, IntrinsicReward


class TestIntrinsicReward(TransformChecks):
    @staticmethod
    def transform(nested=False):
        def key(name):
            return ("agent", name) if nested else name

        return Compose(
            DirectionPrimer(K, out_key=key("direction")),
            IntrinsicReward(
                fixed_encoder(),
                in_keys=(key("observation"), key("direction")),
                out_key=key("intrinsic_reward"),
                reward_key=key("reward"),
                normalize=False,
            ),
        )

    def check_values(self, rollout):
        encoder = fixed_encoder()
        assert "_intrinsic_reward_observation" not in rollout.keys() or (
            "collector" not in rollout.keys()
        ), "collectors drop the private copy"
        with torch.no_grad():
            embedding = encoder(rollout.select("observation"))["embedding"]
            following = encoder(rollout["next"].select("observation"))["embedding"]
        expected = ((following - embedding) * rollout["direction"]).sum(-1, keepdim=True)
        torch.testing.assert_close(rollout["next", "intrinsic_reward"], expected)
        assert expected.abs().max() > 1e-3
        assert set(rollout.keys()).isdisjoint({"embedding", "intrinsic_reward"})

    @staticmethod
    def multi_step():
        multi_step = MultiStep(0.9, 3)
        multi_step.reward_keys = ("reward", "intrinsic_reward")
        return multi_step

    def check_multi_step(self, moved, plain):
        # 12 steps in episodes of 4: three rewards, or fewer at the end of an episode.
        key = ("next", "intrinsic_reward")
        bonus = plain[key].view(3, HORIZON)
        padded = torch.cat([bonus, torch.zeros(3, 2)], 1)
        summed = padded[:, :-2] + 0.9 * padded[:, 1:-1] + 0.81 * padded[:, 2:]
        torch.testing.assert_close(moved[key].view(3, HORIZON), summed)

    @pytest.mark.parametrize("shared", [False, True])
    def test_every_agent_has_a_bonus_along_its_own_or_a_shared_direction(self, shared):
        direction = "direction" if shared else ("agent", "direction")
        bonus = IntrinsicReward(
            fixed_encoder(),
            in_keys=(("agent", "observation"), direction),
            out_key=("agent", "intrinsic_reward"),
            normalize=False,
        )
        env = TransformedEnv(TeamEnv((3,)), Compose(DirectionPrimer(K, out_key=direction), bonus))
        check_env_specs(env)
        rollout = env.rollout(4)
        followed = rollout[direction]
        assert followed.shape == ((3, 4, K) if shared else (3, 4, 2, K))
        followed = followed.unsqueeze(-2) if shared else followed
        ends = rollout["agent", "observation"], rollout["next", "agent", "observation"]
        with torch.no_grad():
            start, end = (fixed_encoder().module(end) for end in ends)
        expected = ((end - start) * followed).sum(-1, keepdim=True)
        found = rollout["next", "agent", "intrinsic_reward"]
        torch.testing.assert_close(found, expected)

    @pytest.mark.slow
    def test_parallel_workers_start_from_the_callers_root(self):
        parallel = ParallelEnv(2, self.env, mp_start_method="fork")
        try:
            state = parallel.rand_action(parallel.reset())
            state["direction"] = -state["direction"]
            self.check_values(parallel.step(state)[:, None])
        finally:
            parallel.close(raise_if_closed=False)

    def test_state_dict_round_trip(self):
        first, second = (IntrinsicReward(fixed_encoder(), decay=0.9) for _ in range(2))
        data = self.env().rollout(4)
        first(data)
        first(data[:2])
        assert set(first.state_dict()) == {
            "deviation.mean",
            "deviation.variance",
            "deviation.weight",
        }, "the encoder is saved by its trainer"
        second.load_state_dict(first.state_dict())
        for transform in (first, second):
            transform.update_statistics = False
        key = ("next", "intrinsic_reward")
        assert torch.equal(first(data.clone())[key], second(data.clone())[key])

    def test_no_env(self):
        data = transitions([1.0, 0.0], [4.0, 1.0], [1.0, -1.0])
        reward = IntrinsicReward(doubler(), normalize=False)(data)["next", "intrinsic_reward"]
        assert reward.tolist() == [[6.0], [-2.0]]

    def test_time_dimensions(self):
        data = transitions([[1.0, 4.0]], [[4.0, 3.0]], [[1.0, 1.0]])
        assert data.batch_size == (1, 2)
        IntrinsicReward(doubler(), normalize=False)(data)
        assert data["next", "intrinsic_reward"].tolist() == [[[6.0], [-2.0]]]

    def test_compose(self):
        data = transitions([1.0], [4.0], [1.0])
        del data["direction"]
        transform = IntrinsicReward(doubler(), normalize=False)
        data = Compose(DirectionPrimer(1), transform)(data)
        assert data["next", "intrinsic_reward"].abs().tolist() == [[6.0]]

    def test_model(self):
        network = TensorDictModule(
            nn.Linear(1, 2), in_keys=[("next", "intrinsic_reward")], out_keys=["out"]
        )
        transform = IntrinsicReward(doubler())
        for model in (
            nn.Sequential(transform, network),
            TensorDictSequential(transform, network),
        ):
            assert model(transitions([1.0], [4.0], [1.0]))["out"].shape == (1, 2)

    @pytest.mark.parametrize("appended", [False, True])
    def test_replay_buffer(self, appended):
        encoder = doubler()
        transform = IntrinsicReward(encoder, normalize=False)
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(8), batch_size=8, transform=None if appended else transform
        )
        if appended:
            buffer.append_transform(transform)
        buffer.extend(transitions([1.0, 0.0], [4.0, 1.0], [1.0, -1.0]))
        key = ("next", "intrinsic_reward")
        assert key not in buffer._storage[:].keys(True, True), "nothing is written on extend"
        assert set(buffer.sample()[key].flatten().tolist()) == {6.0, -2.0}
        encoder.module.weight.data *= 10
        assert set(buffer.sample()[key].flatten().tolist()) == {60.0, -20.0}, "never stale"
        assert key not in buffer._storage[:].keys(True, True)

    def test_inverse(self):
        data = transitions([1.0], [4.0], [1.0])
        assert (self.transform().inv(data) == data).all()


def test_bonus_telescopes_over_an_episode():
    encoder = fixed_encoder()
    env = TransformedEnv(
        PointEnv(), Compose(DirectionPrimer(K), IntrinsicReward(encoder, normalize=False))
    )
    rollout = env.rollout(HORIZON)
    with torch.no_grad():
        first = encoder(rollout[0].select("observation"))["embedding"]
        last = encoder(rollout[-1]["next"].select("observation"))["embedding"]
    total = rollout["next", "intrinsic_reward"].sum()
    torch.testing.assert_close(total, (last - first) @ rollout["direction"][0])


def test_encoder_is_held_by_reference_and_unchanged():
    encoder = fixed_encoder().train()
    transform = IntrinsicReward(encoder)
    env = TransformedEnv(PointEnv(), Compose(DirectionPrimer(K), transform))
    env.rollout(2)
    assert transform.encoder is encoder and transform.clone().encoder is encoder
    assert encoder.training and all(p.requires_grad for p in encoder.parameters())
    assert not list(transform.parameters())
    assert not transform(env.rollout(2))["next", "intrinsic_reward"].requires_grad


def test_encoder_keeps_its_device_when_the_transform_moves():
    encoder = fixed_encoder()
    IntrinsicReward(encoder).to("meta")
    assert {p.device.type for p in encoder.parameters()} == {"cpu"}


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(("of_encoder", "of_data"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_encoder_may_live_on_another_device_than_the_data(of_encoder, of_data):
    data = transitions([1.0, 0.0], [4.0, 1.0], [1.0, -1.0])
    expected = IntrinsicReward(doubler())(data.clone())["next", "intrinsic_reward"]
    reward = IntrinsicReward(doubler().to(of_encoder))(data.to(of_data))["next", "intrinsic_reward"]
    assert reward.device.type == of_data
    torch.testing.assert_close(reward.cpu(), expected)


def test_transform_survives_serialization_and_deepcopy():
    transform = IntrinsicReward(doubler(), normalize=False)
    file = io.BytesIO()
    torch.save(transform, file)
    file.seek(0)
    for twin in (torch.load(file, weights_only=False), copy.deepcopy(transform)):
        data = twin(transitions([1.0], [4.0], [1.0]))
        assert data["next", "intrinsic_reward"].item() == 6.0


def test_reward_spec_declares_the_bonus():
    env = TransformedEnv(
        SerialEnv(2, PointEnv), Compose(DirectionPrimer(K), IntrinsicReward(fixed_encoder()))
    )
    assert env.full_reward_spec["intrinsic_reward"].shape == (2, 1)
    assert env.reward_keys == ["intrinsic_reward", "reward"]


def test_encoder_without_keys_is_refused():
    with pytest.raises(TypeError, match="Linear without in_keys"):
        IntrinsicReward(nn.Linear(1, 1))


def test_encoder_with_two_inputs_is_refused():
    encoder = TensorDictModule(nn.Bilinear(1, 1, 1), in_keys=["a", "b"], out_keys=["c"])
    with pytest.raises(ValueError, match=r"reads \['a', 'b'\]"):
        IntrinsicReward(encoder)


@pytest.mark.parametrize("in_keys", ["observation", ("observation",)])
def test_in_keys_must_be_a_pair(in_keys):
    with pytest.raises(ValueError, match="pass a pair"):
        IntrinsicReward(doubler(), in_keys=in_keys)


def test_embedding_and_direction_of_different_size_are_refused():
    env = TransformedEnv(PointEnv(), Compose(DirectionPrimer(3), IntrinsicReward(fixed_encoder(2))))
    with pytest.raises(ValueError, match="has 2 dimensions but 'direction' has 3"):
        env.rollout(1)


def test_env_without_direction_is_refused():
    env = TransformedEnv(PointEnv(), IntrinsicReward(fixed_encoder()))
    with pytest.raises(KeyError, match="DirectionPrimer"):
        env.rollout(1)


def test_missing_entries_are_named():
    data = transitions([1.0], [4.0], [1.0])
    with pytest.raises(KeyError, match="reward"):
        IntrinsicReward(doubler(), extrinsic_weight=1.0)(data)
    with pytest.raises(KeyError, match="direction"):
        IntrinsicReward(doubler())(data.exclude("direction"))
    with pytest.raises(KeyError, match="'next'"):
        IntrinsicReward(doubler())(data.exclude("next"))


def test_bonus_before_vecnorm_uses_the_raw_observations():
    keep = RenameTransform(["observation"], ["raw"], create_copy=True)
    bonus = IntrinsicReward(fixed_encoder(), normalize=False)
    chain = Compose(DirectionPrimer(K), keep, bonus, VecNormV2(in_keys=["observation"]))
    rollout = TransformedEnv(PointEnv((3,)), chain).rollout(9, break_when_any_done=False)
    with torch.no_grad():
        start, end = (fixed_encoder().module(td["raw"]) for td in (rollout, rollout["next"]))
    expected = ((end - start) * rollout["direction"]).sum(-1, keepdim=True)
    torch.testing.assert_close(rollout["next", "intrinsic_reward"], expected)


def test_native_autoreset_updates_the_copy_of_the_reset_env_only():
    chain = Compose(DirectionPrimer(K), IntrinsicReward(fixed_encoder()))
    env = TransformedEnv(PointEnv((3,)), chain)
    state = env.rollout(2)[:, -1]["next"].exclude("reward")
    before = state["_intrinsic_reward_observation"].clone()
    state = state.set("_reset", torch.tensor([[False], [True], [False]]))
    state["observation"] = state["observation"] + 7
    after = env._reset_on_native_autoreset(state, state)["_intrinsic_reward_observation"]
    assert torch.equal(after[[0, 2]], before[[0, 2]])
    torch.testing.assert_close(after[1], before[1] + 7)


def rnd_networks():
    return nn.Linear(OBSERVATION_DIM, 2), nn.Linear(OBSERVATION_DIM, 2)


@pytest.mark.parametrize("first", [True, False])
def test_two_rewards_under_one_key_are_refused_in_either_order(first):
    ours, theirs = IntrinsicReward(fixed_encoder()), RNDTransform(*rnd_networks())
    pair = (ours, theirs) if first else (theirs, ours)
    with pytest.raises(ValueError, match=r"'intrinsic_reward'.*out_key"):
        TransformedEnv(PointEnv(), Compose(DirectionPrimer(K), *pair)).reset()
    other = IntrinsicReward(fixed_encoder(), out_key="bonus")
    TransformedEnv(
        PointEnv(), Compose(DirectionPrimer(K), other, RNDTransform(*rnd_networks()))
    ).reset()


def test_reward_scaling_of_the_bonus_is_allowed():
    scaled = RewardScaling(loc=0.0, scale=2.0, in_keys=["intrinsic_reward"])
    bonus = IntrinsicReward(fixed_encoder(), normalize=False)
    TransformedEnv(PointEnv(), Compose(DirectionPrimer(K), bonus, scaled)).rollout(2)


def test_double_and_integer_observations_are_cast():
    for dtype in (torch.float64, torch.int32):
        data = transitions([1.0, 0.0], [4.0, 1.0], [1.0, -1.0])
        data["observation"] = data["observation"].to(dtype)
        data["next", "observation"] = data["next", "observation"].to(dtype)
        reward = IntrinsicReward(doubler(), normalize=False)(data)["next", "intrinsic_reward"]
        assert reward.tolist() == [[6.0], [-2.0]] and reward.dtype == torch.float32
