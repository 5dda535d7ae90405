"""RNDBonus: the checks of a transform, its values, and observation statistics."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardScaling, TransformedEnv
from torchrl.envs.transforms import RNDTransform
from torchrl.envs.transforms.rnd import RunningMeanStd
from torchrl.objectives import RNDLoss

from tests.point_env import OBSERVATION_DIM, PointEnv
from tests.transform_checks import TransformChecks
from torchrl_etl.transforms import RNDBonus

KEY = ("next", "intrinsic_reward")


def fixed_loss(**kwargs) -> RNDLoss:
    """The same weights in every process."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        networks = [nn.Linear(OBSERVATION_DIM, 4) for _ in range(2)]
    return RNDLoss(*networks, **kwargs)


def linear_loss(predictor: float = 3.0, target: float = 1.0, **kwargs) -> RNDLoss:
    """One feature of a scalar observation o: the predictor gives 3 o, the target o."""
    networks = [nn.Linear(1, 1, bias=False) for _ in range(2)]
    for network, factor in zip(networks, (predictor, target), strict=True):
        nn.init.constant_(network.weight, factor)
    return RNDLoss(*networks, **kwargs)


def statistics(mean: float, var: float) -> RunningMeanStd:
    found = RunningMeanStd((1,))
    found.mean.fill_(mean), found.var.fill_(var), found.count.fill_(1e6)
    return found


def transitions(ends: list[float]) -> TensorDict:
    column = torch.tensor(ends)[:, None]
    return TensorDict({"observation": 0 * column, "next": {"observation": column}}, [len(ends)])


class TestRNDBonus(TransformChecks):
    @staticmethod
    def transform(nested=False):
        def key(name):
            return ("agent", name) if nested else name

        in_key, out_key = key("observation"), key("intrinsic_reward")
        return RNDBonus(fixed_loss(), in_key=in_key, out_key=out_key, normalize=False)

    def check_values(self, rollout):
        loss = fixed_loss()
        with torch.no_grad():
            seen = rollout["next", "observation"].float()
            error = loss.predictor_network(seen) - loss.target_network(seen)
        torch.testing.assert_close(rollout[KEY], error.square().mean(-1, keepdim=True))
        assert rollout[KEY].abs().max() > 1e-3

    def test_state_dict_round_trip(self):
        first, second = (RNDBonus(fixed_loss(), decay=0.9) for _ in range(2))
        first(PointEnv().rollout(4))
        own = {f"deviation.{name}" for name in ("mean", "variance", "weight")}
        assert set(first.state_dict()) == own, "networks and their statistics belong to the loss"
        second.load_state_dict(first.state_dict())
        assert torch.equal(first.deviation.variance, second.deviation.variance)

    def test_no_env(self):
        data = RNDBonus(linear_loss(), normalize=False)(transitions([1.0, -3.0]))
        assert data[KEY].tolist() == [[4.0], [36.0]]  # (3 o - o)²

    def test_compose(self):
        doubled = RewardScaling(0.0, 2.0, in_keys=[KEY])
        data = Compose(RNDBonus(linear_loss(), normalize=False), doubled)(transitions([1.0]))
        assert data[KEY].tolist() == [[8.0]]

    def test_model(self):
        network = TensorDictModule(nn.Linear(1, 2), in_keys=[KEY], out_keys=["out"])
        for model in (nn.Sequential, TensorDictSequential):
            found = model(RNDBonus(linear_loss()), network)(transitions([1.0, 2.0]))
            assert found["out"].shape == (2, 2)

    def test_replay_buffer(self):
        loss = linear_loss()
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(8), batch_size=8)
        buffer.append_transform(RNDBonus(loss, normalize=False))
        buffer.extend(transitions([1.0, 3.0]))
        assert KEY not in buffer.storage[:].keys(True, True), "nothing is written on extend"
        assert set(buffer.sample()[KEY].flatten().tolist()) == {4.0, 36.0}
        nn.init.constant_(loss.predictor_network.weight, 2.0)
        assert set(buffer.sample()[KEY].flatten().tolist()) == {1.0, 9.0}, "never stale"

    def test_inverse(self):
        data = transitions([1.0])
        assert (self.transform().inv(data) == data).all()


def test_error_is_of_standardized_and_clipped_observations():
    loss = linear_loss(obs_rms=statistics(mean=1.0, var=4.0), obs_clip=3.0)
    bonus = RNDBonus(loss, normalize=False, update_statistics=False)
    # (5 - 1) / 2 = 2 and (-99 - 1) / 2, clipped to -3: (2 o)² = 16 and 36.
    assert bonus(transitions([5.0, -99.0]))[KEY].flatten().tolist() == [16.0, 36.0]


def test_bonus_equals_torchrls_transform_with_the_same_statistics():
    loss = fixed_loss(obs_rms=RunningMeanStd((OBSERVATION_DIM,)))
    networks = loss.target_network, loss.predictor_network
    rollout = TransformedEnv(PointEnv(), RNDTransform(*networks, normalize_obs=False)).rollout(4)
    observation = rollout["next", "observation"]
    theirs = RNDTransform(*networks, normalize_reward=False).eval()
    theirs._obs_rms = RunningMeanStd((OBSERVATION_DIM,))
    theirs._obs_rms.update(observation)
    expected = theirs._step(rollout, rollout["next"].clone())["intrinsic_reward"]
    found = RNDBonus(loss, normalize=False)(rollout)[KEY]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("update", [True, False])
def test_observation_statistics_update_in_eval_mode_unless_disabled(update):
    """Of 1 and 3: mean 2 and variance 1, up to the initial count of 1e-4."""
    loss = linear_loss(obs_rms=RunningMeanStd((1,)))
    bonus = RNDBonus(loss, update_statistics=update).eval()
    bonus(transitions([1.0, 3.0]))
    mean, var = (2.0, 1.0) if update else (0.0, 1.0)
    assert loss.obs_rms.mean.item() == pytest.approx(mean, abs=1e-3)
    assert loss.obs_rms.var.item() == pytest.approx(var, abs=1e-3)


def test_predictor_is_held_by_reference_and_bonus_has_no_gradient():
    loss = linear_loss()
    bonus = RNDBonus(loss)
    assert not list(bonus.parameters())
    assert not bonus(transitions([1.0]))[KEY].requires_grad
    bonus.to("meta")
    assert {parameter.device.type for parameter in loss.parameters()} == {"cpu"}
