import re
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    Categorical,
    Composite,
    LazyTensorStorage,
    MultiStep,
    ReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import (
    ActionScaling,
    Compose,
    GymEnv,
    MultiStepTransform,
    PendulumEnv,
    RenameTransform,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

import torchrl_etl.envs  # noqa: F401 registers the analytic task
from tests.point_env import ACTION_DIM, PointEnv, move
from tests.transform_checks import TransformChecks
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.transforms import SynergyAction

D = 2


def fixed_decoder(action_dim=ACTION_DIM, **kwargs):
    """The same weights in every process."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return SynergyDecoder(D, action_dim, hidden=(8,), **kwargs)


def decode(synergy, decoder=None):
    decoder = decoder or fixed_decoder()
    with torch.no_grad():
        return decoder.module(synergy)


class TestSynergyAction(TransformChecks):
    synergy_key, decoded_key = "synergy", "action"

    @staticmethod
    def transform(nested=False):
        if nested:
            return SynergyAction(
                fixed_decoder(out_keys=[("agent", "action")]),
                synergy_key=("agent", "synergy"),
                executed_key=("agent", "executed_action"),
            )
        return SynergyAction(fixed_decoder())

    def check_values(self, rollout):
        executed = rollout["next", "executed_action"]
        torch.testing.assert_close(executed, decode(rollout[self.synergy_key]))
        expected = move(rollout["observation"], executed)
        torch.testing.assert_close(rollout["next", "observation"], expected)
        # Root holds what was executed before, and zero at the start of each episode.
        before = executed[..., :-1, :].where(~rollout["next", "done"][..., :-1, :], 0.0)
        torch.testing.assert_close(rollout["executed_action"][..., 1:, :], before)
        assert (executed.norm(dim=-1) > 0.1).all()
        assert set(rollout["next"].keys()).isdisjoint({"action", "synergy", "decoded_action"})
        private = [key for td in (rollout, rollout["next"]) for key in td.keys() if key[0] == "_"]
        assert not private
        if "collector" in rollout.keys():
            assert torch.equal(rollout[self.decoded_key], executed)
        assert not executed.requires_grad

    def check_multi_step(self, moved, plain):
        torch.testing.assert_close(moved[self.decoded_key], decode(moved[self.synergy_key]))

    def test_the_callers_root_never_holds_the_decoded_action(self):
        env = self.env()
        state = env.reset()
        assert state["executed_action"].tolist() == [0.0] * ACTION_DIM
        state = env.rand_action(state)
        synergy = state[self.synergy_key].clone()
        state = env.step(state)
        assert torch.equal(state[self.synergy_key], synergy)
        assert ("action" in set(state.keys())) == (self.synergy_key == "action")

    def test_action_spec_is_the_decoders(self):
        for batch_size in [(), (3,)]:
            env = self.env(batch_size=batch_size)
            assert env.action_keys == [self.synergy_key]
            spec = env.full_action_spec[self.synergy_key]
            assert spec == fixed_decoder().synergy_spec.expand(*batch_size, D)
            assert env.observation_spec["executed_action"] == env.base_env.action_spec

    def test_no_env(self):
        transform = self.transform()
        with pytest.raises(RuntimeError, match="inverse pass of an env only"):
            transform(TensorDict({self.synergy_key: torch.zeros(D)}))

    def test_compose(self):
        synergy = torch.linspace(-1, 1, 3 * D).view(3, D)
        data = TensorDict({self.synergy_key: synergy}, [3])
        decoded = Compose(self.transform(), StepCounter()).inv(data)
        torch.testing.assert_close(decoded["action"], decode(synergy))

    def test_model(self):
        network = TensorDictModule(nn.Linear(3, D), ["observation"], [self.synergy_key])
        data = TensorDict({"observation": torch.zeros(3)})
        for model in (
            nn.Sequential(network, self.transform()),
            TensorDictSequential(network, self.transform()),
        ):
            with pytest.raises(RuntimeError, match="the module itself"):
                model(data)

    def test_replay_buffer(self):
        refused = partial(pytest.raises, TypeError, match="cannot be attached to a replay buffer")
        storage = partial(LazyTensorStorage, 4)
        with refused():
            ReplayBuffer(storage=storage(), transform=self.transform())
        with refused():
            TensorDictReplayBuffer(storage=storage(), transform=Compose(self.transform()))
        # TorchRL calls a factory at the buffer's first use.
        buffer = TensorDictReplayBuffer(storage=storage(), transform_factory=self.transform)
        with refused():
            buffer.extend(TensorDict({self.synergy_key: torch.zeros(4, D)}, [4]))
        buffer = TensorDictReplayBuffer(storage=storage())
        with refused():
            buffer.append_transform(self.transform())
        with refused():
            buffer.insert_transform(0, self.transform())
        with refused():
            buffer.append_transform(Compose(StepCounter(), self.transform()))
        buffer.append_transform(StepCounter())

    def test_inverse(self):
        synergy = torch.full((3, D), 0.5, requires_grad=True)
        data = TensorDict({self.synergy_key: synergy}, [3])
        decoded = self.transform().inv(data)["action"]
        torch.testing.assert_close(decoded, decode(synergy))
        assert not decoded.requires_grad
        assert data[self.synergy_key] is synergy, "the input is left alone"
        with pytest.raises(KeyError, match="let the policy write it"):
            self.transform().inv(TensorDict())


class TestSynergyActionUnderTheActionKey(TestSynergyAction):
    """For policies that write ``action`` and nothing else."""

    synergy_key, decoded_key = "action", "decoded_action"

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

    # Workers of this layout start slowly and would tell nothing beyond the parent class.
    test_two_collector_workers_collect = None


def test_nested_synergy_leaves_no_empty_node_behind():
    transform = SynergyAction(fixed_decoder(), action_key=("agent", "action"))
    env = TransformedEnv(PointEnv(nested=True), transform)
    assert list(env.full_action_spec.keys(True)) == ["synergy"]
    rollout = env.rollout(2)
    executed = rollout["next", "executed_action"]
    torch.testing.assert_close(executed, decode(rollout["synergy"]))
    assert set(rollout["agent"].keys()) == {"observation"}


def test_changed_decoder_weights_act_at_the_very_next_step():
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


def test_root_at_reset_is_zero_brought_into_the_bounds():
    env = TransformedEnv(
        PointEnv((2,), low=0.25, high=1.0), SynergyAction(fixed_decoder(low=0.25, high=1.0))
    )
    assert env.reset()["executed_action"].eq(0.25).all()


def test_partial_reset_returns_the_reset_env_to_rest():
    env = TransformedEnv(PointEnv((3,)), SynergyAction(fixed_decoder()))
    state = env.rollout(2)[:, -1]["next"].exclude("reward")
    before = state["executed_action"].clone()
    after = env.reset(state.set("_reset", torch.tensor([[False], [True], [False]])))
    assert after["executed_action"][1].eq(0).all()
    assert torch.equal(after["executed_action"][[0, 2]], before[[0, 2]])


def test_native_autoreset_returns_only_the_reset_env_to_rest():
    env = TransformedEnv(PointEnv((3,)), SynergyAction(fixed_decoder()))
    state = env.rollout(2)[:, -1]["next"].exclude("reward")
    before = state["executed_action"].clone()
    state = state.set("_reset", torch.tensor([[False], [True], [False]]))
    after = env._reset_on_native_autoreset(state, state)
    assert after["executed_action"][1].eq(0).all()
    assert torch.equal(after["executed_action"][[0, 2]], before[[0, 2]])


def collect(env, **kwargs):
    """A batch of 12 frames of TorchRL's collector."""
    collector = Collector(env, None, frames_per_batch=12, total_frames=12, **kwargs)
    (batch,) = collector
    collector.shutdown()
    return batch


def pairs(batch, decoder=None):
    """Asserts that root synergy and root action belong together."""
    torch.testing.assert_close(batch["action"], decode(batch["synergy"], decoder))


@pytest.mark.parametrize(
    "kwargs",
    [{}, {"device": "cpu"}, {"storing_device": "cpu"}, {"use_buffers": False}],
    ids=str,
)
@pytest.mark.parametrize("layout", ["single", "batched", "around serial", "no device", "appended"])
def test_collected_pairs_are_together_at_the_root(layout, kwargs):
    env = {
        "single": PointEnv,
        "batched": partial(PointEnv, (3,)),
        "around serial": partial(SerialEnv, 2, PointEnv),
        "no device": partial(GymEnv, "torchrl_etl/Overactuated-v0", device=None),
        "appended": partial(TransformedEnv, PointEnv(), StepCounter()),
    }[layout]()
    decoder = fixed_decoder(16 if layout == "no device" else ACTION_DIM)
    env = TransformedEnv(env, SynergyAction(decoder))
    for steps in (1, 3):  # a collector does not change what rollouts and resets are
        env.rollout(steps)
    pairs(collect(env, **kwargs), decoder)


def keep_at_root():
    return RenameTransform([("next", "executed_action")], ["action"], create_copy=True)


def test_multi_step_leaves_pairs_together():
    make = partial(TransformedEnv, PointEnv(), SynergyAction(fixed_decoder()))
    pairs(collect(make(), postproc=MultiStep(0.9, 3)))


def test_multi_step_leaves_pairs_of_workers_together_behind_a_rename():
    def transformed():
        return TransformedEnv(PointEnv(), SynergyAction(fixed_decoder()))

    batch = collect(
        SerialEnv(2, transformed), postproc=nn.Sequential(keep_at_root(), MultiStep(0.9, 3))
    )
    pairs(batch)


@pytest.mark.parametrize("collected", [True, False])
def test_multi_step_transform_of_a_buffer_leaves_pairs_together(collected):
    env = TransformedEnv(PointEnv(), SynergyAction(fixed_decoder()))
    batch = (
        collect(env) if collected else keep_at_root()(env.rollout(12, break_when_any_done=False))
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20), transform=MultiStepTransform(3, 0.9), batch_size=8
    )
    buffer.extend(batch)
    pairs(buffer.sample())
    moved = buffer[:]["next", "executed_action"] - decode(buffer[:]["synergy"])
    assert moved.abs().max() > 1e-3


class _Clip(Transform):
    """Halves the range that the simulator gets, as an inner safety clip would."""

    def __init__(self) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action):
        return action.clamp(-0.5, 0.5)


def test_executed_action_behind_a_scaling_is_what_ran_and_root_action_what_was_decoded():
    env = TransformedEnv(
        PointEnv(low=0.0, high=1.0), Compose(ActionScaling(), SynergyAction(fixed_decoder()))
    )
    check_env_specs(env)
    rollout = collect(env)
    decoded, executed = rollout["action"], rollout["next", "executed_action"]
    torch.testing.assert_close(decoded, decode(rollout["synergy"]))
    torch.testing.assert_close(executed, (decoded + 1) / 2)
    expected = move(rollout["observation"], executed)
    torch.testing.assert_close(rollout["next", "observation"], expected)
    assert env.observation_spec["executed_action"] == env.base_env.action_spec
    assert rollout["executed_action"][0].eq(0).all()


def test_executed_action_behind_a_clip_is_clipped():
    decoder = fixed_decoder()
    with torch.no_grad():
        decoder.module.scale.fill_(20.0)
    env = TransformedEnv(PointEnv(), Compose(_Clip(), SynergyAction(decoder)))
    rollout = collect(env)
    assert rollout["action"].abs().max() > 0.6
    assert torch.equal(rollout["next", "executed_action"], rollout["action"].clamp(-0.5, 0.5))


def test_scaling_in_an_inner_environment_is_warned_of():
    inner = TransformedEnv(PointEnv(low=0.0, high=1.0), ActionScaling())
    with pytest.warns(UserWarning, match="append SynergyAction to that environment"):
        TransformedEnv(inner, SynergyAction(fixed_decoder()), auto_unwrap=False)


def test_repr_says_what_decodes_into_what():
    shown = repr(SynergyAction(fixed_decoder()))
    assert "SynergyDecoder of 2 numbers into 5 actuators in [-1, 1]" in shown
    assert "decoded_key='action'" in shown


def test_an_env_that_is_not_batch_locked_takes_any_batch():
    env = TransformedEnv(PendulumEnv(), SynergyAction(fixed_decoder(1, low=-2.0, high=2.0)))
    start = env.base_env.gen_params(batch_size=[4])
    state = env.reset(start, set_state=True).set("synergy", torch.zeros(4, D))
    assert state["executed_action"].shape == (4, 1)
    assert env.step(state)["next", "executed_action"].shape == (4, 1)


def test_works_on_a_real_env():
    env = TransformedEnv(GymEnv("Pendulum-v1"), SynergyAction(fixed_decoder(1, low=-2.0, high=2.0)))
    env.set_seed(0)
    rollout = env.rollout(3)
    twin = GymEnv("Pendulum-v1")
    twin.set_seed(0)
    state = twin.reset()
    for step in rollout:
        state = twin.step(state.set("action", step["next", "executed_action"]))["next"]
        torch.testing.assert_close(state["observation"], step["next", "observation"])


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


def test_bounds_that_differ_between_actuators_are_compared_one_by_one():
    low = [-1.0, -1.0, 0.0, 0.0, 0.0]
    env = PointEnv(low=torch.tensor(low))
    attach(env, SynergyAction(fixed_decoder(low=low)))
    with pytest.raises(ValueError, match=re.escape("bounded by [-1, 1] at the widest")):
        attach(env, SynergyAction(fixed_decoder(low=low[::-1])))


def test_serial_env_checks_too():
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
