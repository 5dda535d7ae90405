"""SynergyAction: a batch pairs synergy, decoded and executed action of the same step."""

from functools import partial

import pytest
import torch
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, MultiStep, TensorDictReplayBuffer
from torchrl.envs import (
    ActionScaling,
    Compose,
    GymEnv,
    MultiStepTransform,
    RenameTransform,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

import torchrl_etl.envs  # noqa: F401 registers the analytic task
from tests.latent_action_checks import decode, fixed_decoder
from tests.point_env import ACTION_DIM, PointEnv, move
from torchrl_etl.transforms import SynergyAction


def collect(env, **kwargs):
    """A batch of 12 frames of TorchRL's collector."""
    collector = Collector(env, None, frames_per_batch=12, total_frames=12, **kwargs)
    (batch,) = collector
    collector.shutdown()
    return batch


def assert_paired(batch, decoder=None):
    """The root action is the decoded root synergy."""
    torch.testing.assert_close(batch["action"], decode(batch["synergy"], decoder))


@pytest.mark.parametrize(
    "kwargs",
    [{}, {"device": "cpu"}, {"storing_device": "cpu"}, {"use_buffers": False}],
    ids=str,
)
@pytest.mark.parametrize("layout", ["single", "batched", "around serial", "no device", "appended"])
def test_collected_root_pairs_synergy_and_action_of_one_step(layout, kwargs):
    env = {
        "single": PointEnv,
        "batched": partial(PointEnv, (3,)),
        "around serial": partial(SerialEnv, 2, PointEnv),
        "no device": partial(GymEnv, "torchrl_etl/Overactuated-v0", device=None),
        "appended": partial(TransformedEnv, PointEnv(), StepCounter()),
    }[layout]()
    decoder = fixed_decoder(16 if layout == "no device" else ACTION_DIM)
    env = TransformedEnv(env, SynergyAction(decoder))
    for steps in (1, 3):  # rollouts before collection must not matter
        env.rollout(steps)
    assert_paired(collect(env, **kwargs), decoder)


def keep_at_root():
    return RenameTransform([("next", "executed_action")], ["action"], create_copy=True)


def test_multi_step_keeps_pairs():
    make = partial(TransformedEnv, PointEnv(), SynergyAction(fixed_decoder()))
    assert_paired(collect(make(), postproc=MultiStep(0.9, 3)))


def test_multi_step_after_a_rename_keeps_pairs_of_workers():
    def transformed():
        return TransformedEnv(PointEnv(), SynergyAction(fixed_decoder()))

    batch = collect(
        SerialEnv(2, transformed), postproc=nn.Sequential(keep_at_root(), MultiStep(0.9, 3))
    )
    assert_paired(batch)


@pytest.mark.parametrize("collected", [True, False])
def test_multi_step_transform_of_a_buffer_keeps_pairs(collected):
    env = TransformedEnv(PointEnv(), SynergyAction(fixed_decoder()))
    batch = (
        collect(env) if collected else keep_at_root()(env.rollout(12, break_when_any_done=False))
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20), transform=MultiStepTransform(3, 0.9), batch_size=8
    )
    buffer.extend(batch)
    assert_paired(buffer.sample())
    moved = buffer[:]["next", "executed_action"] - decode(buffer[:]["synergy"])
    assert moved.abs().max() > 1e-3


class _Clip(Transform):
    """A safety clip that halves the range of executed actions."""

    def __init__(self) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action):
        return action.clamp(-0.5, 0.5)


def test_executed_action_is_scaled_and_root_action_is_as_decoded():
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


def test_scaling_in_an_inner_env_warns():
    inner = TransformedEnv(PointEnv(low=0.0, high=1.0), ActionScaling())
    with pytest.warns(UserWarning, match="append SynergyAction to that environment"):
        TransformedEnv(inner, SynergyAction(fixed_decoder()), auto_unwrap=False)


def test_executed_actions_replay_a_pendulum_rollout():
    env = TransformedEnv(GymEnv("Pendulum-v1"), SynergyAction(fixed_decoder(1, low=-2.0, high=2.0)))
    env.set_seed(0)
    rollout = env.rollout(3)
    twin = GymEnv("Pendulum-v1")
    twin.set_seed(0)
    state = twin.reset()
    for step in rollout:
        state = twin.step(state.set("action", step["next", "executed_action"]))["next"]
        torch.testing.assert_close(state["observation"], step["next", "observation"])
