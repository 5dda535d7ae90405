"""Checks that every LatentAction must pass, and a decoder with fixed weights."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, StepCounter, TransformedEnv

from tests.point_env import ACTION_DIM, PointEnv, move
from tests.transform_checks import TransformChecks
from torchrl_etl.modules import SynergyDecoder

D = 2


def fixed_decoder(action_dim=ACTION_DIM, **kwargs):
    """A decoder with the same weights in every process."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return SynergyDecoder(D, action_dim, hidden=(8,), **kwargs)


def decode(synergy, decoder=None):
    decoder = decoder or fixed_decoder()
    with torch.no_grad():
        return decoder.module(synergy)


def make_buffer(**kwargs):
    return TensorDictReplayBuffer(storage=LazyTensorStorage(4), **kwargs)


def refused_in_a_buffer():
    return pytest.raises(RuntimeError, match="In a replay buffer it would overwrite recorded")


class LatentActionChecks(TransformChecks):
    """Checks of a transform with the values of :func:`fixed_decoder`; subclasses name the keys."""

    latent_key: str
    decoded_key = "action"

    def check_values(self, rollout):
        executed = rollout["next", "executed_action"]
        torch.testing.assert_close(executed, decode(rollout[self.latent_key]))
        expected = move(rollout["observation"], executed)
        torch.testing.assert_close(rollout["next", "observation"], expected)
        # The root holds the previous executed action, and zero at the start of an episode.
        before = executed[..., :-1, :].where(~rollout["next", "done"][..., :-1, :], 0.0)
        torch.testing.assert_close(rollout["executed_action"][..., 1:, :], before)
        assert (executed.norm(dim=-1) > 0.1).all()
        assert set(rollout["next"].keys()).isdisjoint({"action", self.latent_key, "decoded_action"})
        private = [key for td in (rollout, rollout["next"]) for key in td.keys() if key[0] == "_"]
        assert not private
        if "collector" in rollout.keys():
            assert torch.equal(rollout[self.decoded_key], executed)
        assert not executed.requires_grad

    def check_multi_step(self, moved, plain):
        torch.testing.assert_close(moved[self.decoded_key], decode(moved[self.latent_key]))

    def test_the_callers_root_never_holds_the_decoded_action(self):
        env = self.env()
        state = env.reset()
        assert state["executed_action"].tolist() == [0.0] * ACTION_DIM
        state = env.rand_action(state)
        latent = state[self.latent_key].clone()
        state = env.step(state)
        assert torch.equal(state[self.latent_key], latent)
        assert ("action" in set(state.keys())) == (self.latent_key == "action")

    def test_action_spec_is_the_latents(self):
        for batch_size in [(), (3,)]:
            env = self.env(batch_size=batch_size)
            assert env.action_keys == [self.latent_key]
            spec = env.full_action_spec[self.latent_key]
            assert spec == fixed_decoder().synergy_spec.expand(*batch_size, D)
            assert env.observation_spec["executed_action"] == env.base_env.action_spec

    def test_no_env(self):
        transform = self.transform()
        with pytest.raises(RuntimeError, match="inverse pass of an env only"):
            transform(TensorDict({self.latent_key: torch.zeros(D)}))

    def test_compose(self):
        data = TensorDict({self.latent_key: torch.zeros(3, D)}, [3])
        pipeline = Compose(self.transform(), StepCounter())
        with pytest.raises(RuntimeError, match="inverse pass of an env only"):
            pipeline.inv(data)

    def test_model(self):
        network = TensorDictModule(nn.Linear(3, D), ["observation"], [self.latent_key])
        data = TensorDict({"observation": torch.zeros(3)})
        for model in (
            nn.Sequential(network, self.transform()),
            TensorDictSequential(network, self.transform()),
        ):
            with pytest.raises(RuntimeError, match="the module itself"):
                model(data)

    def test_replay_buffer(self):
        data = self.env().rollout(4)
        data[self.latent_key] = torch.zeros(4, D)
        buffers = {
            "constructed": make_buffer(transform=self.transform()),
            "composed": make_buffer(transform=Compose(self.transform())),
            "at first use": make_buffer(transform_factory=self.transform),
            "appended": make_buffer().append_transform(self.transform()),
            "inserted": make_buffer().insert_transform(0, self.transform()),
            "appended in a Compose": make_buffer().append_transform(
                Compose(StepCounter(), self.transform())
            ),
        }
        for buffer in buffers.values():
            with refused_in_a_buffer():
                buffer.extend(data)
            assert not len(buffer)
        pipeline = TransformedEnv(PointEnv(), Compose(self.transform())).transform
        buffer = make_buffer(transform=pipeline)
        buffer.extend(data)  # looks like a step of the env
        with refused_in_a_buffer():
            buffer.sample(2)

    def test_inverse(self):
        latent = torch.full((3, D), 0.5, requires_grad=True)
        data = TensorDict({self.latent_key: latent}, [3])
        with pytest.raises(RuntimeError, match="call its decode"):
            self.transform().inv(data)
        decoded = self.transform().decode(latent)
        torch.testing.assert_close(decoded, decode(latent))
        assert not decoded.requires_grad
        env = self.env(batch_size=(3,))
        inverted = env.transform.inv(data)
        torch.testing.assert_close(inverted["action"], decode(latent))
        assert data[self.latent_key] is latent, "the input is left alone"
        with pytest.raises(KeyError, match="let the policy write it"):
            env.transform.inv(TensorDict())
