"""DirectionPrimer: the checks of a transform, distributions, seeds, and refused arguments."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    Compose,
    InitTracker,
    ParallelEnv,
    StepCounter,
    TensorDictPrimer,
    TransformedEnv,
)

from tests.point_env import PointEnv, TeamEnv
from tests.transform_checks import TransformChecks
from torchrl_etl.transforms import DirectionPrimer

K = 4


def episodes(rollout):
    """(direction, next direction, done) of each env in turn, time first."""
    rollout = rollout if rollout.ndim > 1 else rollout[None]
    for env in rollout.reshape(-1, rollout.shape[-1]):
        yield env["direction"], env["next", "direction"], env["next", "done"][:, 0]


class TestDirectionPrimer(TransformChecks):
    @staticmethod
    def transform(nested=False):
        return DirectionPrimer(K, out_key=("agent", "direction") if nested else "direction")

    def check_values(self, rollout):
        firsts = []
        for direction, following, done in episodes(rollout):
            torch.testing.assert_close(direction.norm(dim=-1), torch.ones(len(direction)))
            torch.testing.assert_close(following, direction)
            changed = (direction[1:] != direction[:-1]).any(-1)
            assert torch.equal(changed, done[:-1]), "redrawn exactly where an episode ends"
            firsts.append(direction[0])
        assert len({tuple(first.tolist()) for first in firsts}) == len(firsts)

    # Processes share torch's default seed, so set_seed is needed for distinct draws.
    @pytest.mark.slow
    def test_parallel_env_of_transformed_envs_keeps_its_specs(self):
        parallel = ParallelEnv(2, self.env, mp_start_method="fork")
        try:
            parallel.set_seed(0)
            self.check_values(parallel.rollout(6, break_when_any_done=False))
        finally:
            parallel.close(raise_if_closed=False)

    def test_partial_reset_redraws_for_the_reset_env(self):
        env = self.env(batch_size=(3,))
        before = env.reset()
        mask = torch.tensor([[False], [True], [False]])
        after = env.reset(before.clone().set("_reset", mask))
        changed = (after["direction"] != before["direction"]).any(-1)
        assert changed.tolist() == [False, True, False]

    def test_native_autoreset_redraws_for_the_reset_envs_only(self):
        env = self.env(batch_size=(3,))
        state = env.reset().set("_reset", torch.tensor([[True], [False], [False]]))
        before = state["direction"].clone()
        after = env._reset_on_native_autoreset(state, state)
        assert (after["direction"] != before).any(-1).tolist() == [True, False, False]

    def test_no_env(self):
        data = self.transform()(TensorDict(batch_size=[2, 3]))
        assert data["direction"].shape == (2, 3, K)

    def test_compose(self):
        data = Compose(self.transform(), DirectionPrimer(2, out_key="other"))(TensorDict())
        assert (data["direction"].shape, data["other"].shape) == ((K,), (2,))

    def test_before_a_transform_whose_keys_depend_on_the_env(self):
        env = TransformedEnv(PointEnv(), Compose(self.transform(), InitTracker()))
        assert {"direction", "is_init"} <= set(env.rollout(2).keys())
        env = TransformedEnv(PointEnv(), Compose(self.transform(), InitTracker("direction")))
        with pytest.raises(ValueError, match="DirectionPrimer and InitTracker both write"):
            env.reset()

    def test_model(self):
        network = TensorDictModule(nn.Linear(K, 2), in_keys=["direction"], out_keys=["out"])
        for model in (
            nn.Sequential(self.transform(), network),
            TensorDictSequential(self.transform(), network),
        ):
            assert model(TensorDict(batch_size=[3]))["out"].shape == (3, 2)

    def test_replay_buffer(self):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(4), transform=self.transform(), batch_size=4
        )
        recorded = torch.eye(K)
        buffer.extend(TensorDict({"direction": recorded}, [K]))
        sampled = buffer.sample()["direction"]
        assert (sampled[:, None] == recorded).all(-1).any(-1).all(), "recorded directions are kept"

    def test_inverse(self):
        data = TensorDict({"direction": torch.ones(K)})
        assert (self.transform().inv(data) == data).all()


def test_same_torch_seed_gives_the_same_directions():
    env = TransformedEnv(PointEnv((3,)), DirectionPrimer(K))
    draws = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        draws.append(env.reset()["direction"])
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])


@pytest.mark.parametrize("dimension", [2, 8])
def test_sphere_is_uniform(dimension):
    draws = DirectionPrimer(dimension).draw(torch.Size([20_000]))
    torch.testing.assert_close(draws.norm(dim=-1), torch.ones(20_000))
    # A uniform unit vector has mean 0, covariance I/k and fourth moments 3/(k(k+2)).
    assert draws.mean(0).abs().max() < 0.02
    assert (draws.T @ draws / 20_000 - torch.eye(dimension) / dimension).abs().max() < 0.02
    fourth = torch.full((dimension,), 3 / (dimension * (dimension + 2)))
    torch.testing.assert_close(draws.pow(4).mean(0), fourth, rtol=0.05, atol=0)


def test_sphere_in_one_dimension_is_a_fair_sign():
    draws = DirectionPrimer(1).draw(torch.Size([10_000]))
    assert set(draws.unique().tolist()) == {-1.0, 1.0}
    assert abs(draws.mean()) < 0.05


@pytest.mark.parametrize("count", [None, 1, 3])
def test_orthonormal_draws_are_rows_of_the_identity_equally_often(count):
    draws = DirectionPrimer(K, kind="orthonormal", num_directions=count).draw(torch.Size([8_000]))
    frequency = draws.mean(0)
    expected = torch.zeros(K)
    expected[: count or K] = 1 / (count or K)
    assert ((draws == 0) | (draws == 1)).all() and (draws.sum(-1) == 1).all()
    assert (frequency - expected).abs().max() < 0.03


@pytest.mark.parametrize("kind", ["sphere", "orthonormal"])
def test_spec_is_bounded_and_contains_the_draws(kind):
    env = TransformedEnv(PointEnv((2,)), DirectionPrimer(K, kind=kind))
    spec = env.observation_spec["direction"]
    assert spec.shape == (2, K) and spec.space.low.eq(-1).all() and spec.space.high.eq(1).all()
    assert spec.is_in(env.reset()["direction"])


def test_other_transforms_may_follow():
    env = TransformedEnv(PointEnv((2,)), Compose(DirectionPrimer(K), StepCounter()))
    assert env.rollout(2)["direction"].shape == (2, 2, K)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"embedding_dim": 0}, "embedding_dim is 0"),
        ({"embedding_dim": 2, "kind": "spheer"}, "'spheer'.*nearest: sphere"),
        ({"embedding_dim": 2, "num_directions": 2}, "sphere has no finite set"),
        ({"embedding_dim": 2, "kind": "orthonormal", "num_directions": 3}, "is 3, but only 2"),
    ],
)
def test_bad_arguments_are_refused_at_construction(arguments, message):
    with pytest.raises(ValueError, match=message):
        DirectionPrimer(**arguments)


def test_two_primers_of_one_key_are_refused():
    env = TransformedEnv(PointEnv(), DirectionPrimer(2))
    with pytest.raises(ValueError, match=r"DirectionPrimer writes 'direction'.*out_key"):
        env.append_transform(DirectionPrimer(3))
    with pytest.raises(ValueError, match="both write 'direction'"):
        late = TensorDictPrimer(direction=Unbounded((2,)), expand_specs=True)
        TransformedEnv(PointEnv(), Compose(DirectionPrimer(2), late)).reset()


def test_every_agent_draws_its_own_direction():
    env = TransformedEnv(TeamEnv((3,)), DirectionPrimer(2, out_key=("agent", "direction")))
    direction = env.reset()["agent", "direction"]
    assert direction.shape == (3, TeamEnv.AGENTS, 2)
    assert len(direction.flatten(0, 1).unique(dim=0)) == 3 * TeamEnv.AGENTS
