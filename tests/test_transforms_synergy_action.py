"""SynergyAction: the checks of a latent action, weights in use, and refused decoders."""

import re

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Categorical, Composite
from torchrl.envs import Compose, PendulumEnv, SerialEnv, StepCounter, TransformedEnv

from tests.latent_action_checks import D, LatentActionChecks, decode, fixed_decoder
from tests.point_env import ACTION_DIM, PointEnv
from torchrl_etl.transforms import SynergyAction


class TestSynergyAction(LatentActionChecks):
    latent_key = "synergy"

    @staticmethod
    def transform(nested=False):
        if nested:
            return SynergyAction(
                fixed_decoder(out_keys=[("agent", "action")]),
                synergy_key=("agent", "synergy"),
                executed_key=("agent", "executed_action"),
            )
        return SynergyAction(fixed_decoder())

    # Worker processes start slowly; those of TestLatentAction include SynergyAction.
    test_two_collector_workers_collect = None


class TestSynergyActionUnderTheActionKey(LatentActionChecks):
    """For policies that write ``action`` and nothing else."""

    latent_key, decoded_key = "action", "decoded_action"

    @staticmethod
    def transform(nested=False):
        if nested:
            return SynergyAction(
                fixed_decoder(),
                synergy_key=("agent", "action"),
                action_key=("agent", "action"),
                executed_key=("agent", "executed_action"),
            )
        return SynergyAction(fixed_decoder(), synergy_key="action")

    def test_action_spec_is_one_leaf(self):
        assert self.env().action_spec == fixed_decoder().synergy_spec

    # Worker processes start slowly; those of TestLatentAction suffice.
    test_two_collector_workers_collect = None


def test_nested_action_key_leaves_no_empty_node():
    transform = SynergyAction(fixed_decoder(), action_key=("agent", "action"))
    env = TransformedEnv(PointEnv(nested=True), transform)
    assert list(env.full_action_spec.keys(True)) == ["synergy"]
    rollout = env.rollout(2)
    executed = rollout["next", "executed_action"]
    torch.testing.assert_close(executed, decode(rollout["synergy"]))
    assert set(rollout["agent"].keys()) == {"observation"}


def test_changed_decoder_weights_apply_at_the_next_step():
    decoder = fixed_decoder()
    env = TransformedEnv(PointEnv(), SynergyAction(decoder))
    state = env.reset().set("synergy", torch.ones(D))
    before = env.step(state.clone())["next", "executed_action"]
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter.neg_()
    after = env.step(state.clone())["next", "executed_action"]
    torch.testing.assert_close(after, decode(torch.ones(D), decoder))
    assert not torch.allclose(after, before)


def test_state_dict_of_one_env_updates_the_decoder_of_another():
    decoder = fixed_decoder()
    env = TransformedEnv(PointEnv(), SynergyAction(decoder))
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter.add_(0.1)
    other = TransformedEnv(PointEnv(), SynergyAction(fixed_decoder()))
    other.load_state_dict(env.state_dict())
    synergy = torch.full((D,), 0.3)
    torch.testing.assert_close(decode(synergy, other.transform.module), decode(synergy, decoder))


def test_residual_widens_the_synergy():
    decoder = fixed_decoder(residual=0.5)
    env = TransformedEnv(PointEnv((3,)), SynergyAction(decoder))
    assert env.full_action_spec["synergy"].shape == (3, D + ACTION_DIM)
    rollout = env.rollout(3)
    executed = rollout["next", "executed_action"]
    torch.testing.assert_close(executed, decode(rollout["synergy"], decoder))


def test_executed_action_at_reset_is_zero_clipped_to_the_bounds():
    env = TransformedEnv(
        PointEnv((2,), low=0.25, high=1.0), SynergyAction(fixed_decoder(low=0.25, high=1.0))
    )
    assert env.reset()["executed_action"].eq(0.25).all()


@pytest.mark.parametrize("native", [False, True])
def test_partial_reset_clears_the_executed_action_of_that_env_only(native):
    env = TransformedEnv(PointEnv((3,)), SynergyAction(fixed_decoder()))
    state = env.rollout(2)[:, -1]["next"].exclude("reward")
    before = state["executed_action"].clone()
    state = state.set("_reset", torch.tensor([[False], [True], [False]]))
    after = env._reset_on_native_autoreset(state, state) if native else env.reset(state)
    assert after["executed_action"][1].eq(0).all()
    assert torch.equal(after["executed_action"][[0, 2]], before[[0, 2]])


def test_repr_names_decoder_and_keys():
    shown = repr(SynergyAction(fixed_decoder()))
    assert "SynergyDecoder of 2 numbers into 5 actuators in [-1, 1]" in shown
    assert "decoded_key='action'" in shown


def test_an_env_that_is_not_batch_locked_takes_any_batch():
    env = TransformedEnv(PendulumEnv(), SynergyAction(fixed_decoder(1, low=-2.0, high=2.0)))
    start = env.base_env.gen_params(batch_size=[4])
    state = env.reset(start, set_state=True).set("synergy", torch.zeros(4, D))
    assert state["executed_action"].shape == (4, 1)
    assert env.step(state)["next", "executed_action"].shape == (4, 1)


def attach(env, transform):
    return TransformedEnv(env, transform)


def append(env, transform):
    return TransformedEnv(env, StepCounter()).append_transform(transform)


def compose(env, transform):
    return TransformedEnv(env, Compose(StepCounter(), transform))


@pytest.mark.parametrize("way", [attach, append, compose])
class TestMismatchIsRefusedAtAttachment:
    def test_number_of_actuators(self, way):
        with pytest.raises(ValueError, match=r"writes 7 actuators .* 'action' has 5"):
            way(PointEnv(), SynergyAction(fixed_decoder(7)))

    @pytest.mark.parametrize("batch_size", [(), (2,)])
    def test_bounds(self, way, batch_size):
        env = PointEnv(batch_size, low=0.0, high=1.0)
        with pytest.raises(ValueError, match=re.escape("acts in [-1, 1] but")) as error:
            way(env, SynergyAction(fixed_decoder()))
        assert "bounded by [0, 1]" in str(error.value)

    def test_action_key(self, way):
        with pytest.raises(ValueError, match=r"\('agent', 'action'\).*action_key"):
            way(PointEnv(nested=True), SynergyAction(fixed_decoder()))

    def test_discrete_action(self, way):
        env = PointEnv()
        env.action_spec = Composite(action=Categorical(ACTION_DIM))
        with pytest.raises(ValueError, match="Categorical; a synergy decoder needs a continuous"):
            way(env, SynergyAction(fixed_decoder()))

    def test_observation_key_that_is_taken(self, way):
        with pytest.raises(ValueError, match="'observation' is an observation"):
            way(PointEnv(), SynergyAction(fixed_decoder(), executed_key="observation"))

    def test_transform_can_be_attached_elsewhere_afterwards(self, way):
        transform = SynergyAction(fixed_decoder())
        with pytest.raises(ValueError):
            way(PointEnv(low=0.0), transform)
        attach(PointEnv(), transform).rollout(1)


def test_bounds_are_compared_per_actuator():
    low = [-1.0, -1.0, 0.0, 0.0, 0.0]
    env = PointEnv(low=torch.tensor(low))
    attach(env, SynergyAction(fixed_decoder(low=low)))
    with pytest.raises(ValueError, match=re.escape("bounded by [-1, 1] at the widest")):
        attach(env, SynergyAction(fixed_decoder(low=low[::-1])))


def test_mismatch_is_refused_around_a_serial_env():
    with pytest.raises(ValueError, match="writes 7 actuators"):
        attach(SerialEnv(2, PointEnv), SynergyAction(fixed_decoder(7)))


def test_decoder_without_its_attributes_is_refused():
    decoder = TensorDictModule(nn.Linear(D, 5), in_keys=["synergy"], out_keys=["action"])
    with pytest.raises(TypeError, match="without synergy_spec, action_dim, low, high"):
        SynergyAction(decoder)


def test_colliding_keys_are_refused():
    with pytest.raises(ValueError, match="'action', which already names"):
        SynergyAction(fixed_decoder(), executed_key="action")
    with pytest.raises(ValueError, match="decoded_key is 'synergy', which already names"):
        SynergyAction(fixed_decoder(), decoded_key="synergy")
