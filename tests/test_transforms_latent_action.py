"""LatentAction: the checks of a latent action, with any kind of module and spec."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.envs import Compose, GymEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.latent_action_checks import D, LatentActionChecks, fixed_decoder
from tests.point_env import ACTION_DIM, PointEnv
from torchrl_etl.transforms import LatentAction, SynergyAction

SPEC = Bounded(-1, 1, shape=(D,))


def fixed_module(key="action"):
    """The network of :func:`fixed_decoder`, without the attributes of a decoder."""
    return TensorDictModule(fixed_decoder().module, ["z"], [key])


class TestLatentAction(LatentActionChecks):
    latent_key = "latent"

    @staticmethod
    def transform(nested=False):
        if nested:
            return LatentAction(
                fixed_module(("agent", "action")),
                SPEC,
                latent_key=("agent", "latent"),
                executed_key=("agent", "executed_action"),
            )
        return LatentAction(fixed_module(), SPEC)

    @classmethod
    def worker_envs(cls):
        """LatentAction in one worker and its subclass in the other: workers start slowly."""
        return [cls.env, cls.of_synergies]

    @staticmethod
    def of_synergies():
        return TransformedEnv(PointEnv(), SynergyAction(fixed_decoder(), synergy_key="latent"))


def categorical_module(size, shape=()):
    """An embedding of ``size`` actions and the spec of their indices."""
    moves = nn.Embedding(size, ACTION_DIM)
    torch.nn.init.uniform_(moves.weight, -1, 1)
    return TensorDictModule(moves, ["z"], ["action"]), Categorical(size, shape=shape)


@pytest.mark.parametrize("batch_size", [(), (3,)])
def test_categorical_latent_selects_a_row_of_the_embedding(batch_size):
    module, spec = categorical_module(4)
    env = TransformedEnv(PointEnv(batch_size), LatentAction(module, spec))
    check_env_specs(env)
    rollout = env.rollout(3)
    assert rollout["latent"].shape == (*batch_size, 3)
    expected = module.module.weight.detach()[rollout["latent"]]
    assert torch.equal(rollout["next", "executed_action"], expected)


def push(latent):
    """One of CartPole's two actions, as a scalar."""
    return (latent.sum(-1) > 0).long()


def cart_pole():
    return GymEnv("CartPole-v1", categorical_action_encoding=True)


def with_push(env):
    return TransformedEnv(env, LatentAction(TensorDictModule(push, ["z"], ["action"]), SPEC))


@pytest.mark.parametrize(
    ("make", "batch_size"),
    [
        (lambda: with_push(cart_pole()), ()),
        (lambda: with_push(SerialEnv(2, cart_pole)), (2,)),
        (lambda: SerialEnv(2, lambda: with_push(cart_pole())), (2,)),
    ],
)
def test_scalar_action_is_decoded_for_every_row(make, batch_size):
    env = make()
    check_env_specs(env)
    rollout = env.rollout(3)
    assert rollout["latent"].shape == (*batch_size, 3, D)
    assert torch.equal(rollout["next", "executed_action"], push(rollout["latent"]))


def test_scalar_action_for_a_vector_action_spec_is_refused():
    module = TensorDictModule(push, ["z"], ["action"])
    with pytest.raises(ValueError, match=r"makes actions of shape \[\] .* 'action' has \[5\]"):
        TransformedEnv(PointEnv(), LatentAction(module, SPEC))


@pytest.mark.parametrize("place", [lambda t: t, lambda t: Compose(StepCounter(), t)])
def test_module_of_another_width_is_refused_at_attachment(place):
    module = TensorDictModule(nn.Linear(D, 7), ["z"], ["action"])
    with pytest.raises(ValueError, match=r"makes actions of shape \[7\] .* 'action' has \[5\]"):
        TransformedEnv(PointEnv(), place(LatentAction(module, SPEC)))


def test_module_without_keys_or_with_two_inputs_is_refused():
    with pytest.raises(TypeError, match="Linear without in_keys and out_keys; wrap it"):
        LatentAction(nn.Linear(2, 5), SPEC)
    with pytest.raises(ValueError, match=r"reads \['a', 'b'\]"):
        LatentAction(TensorDictModule(torch.add, ["a", "b"], ["action"]), SPEC)


def test_repr_names_module_and_keys():
    shown = repr(LatentAction(fixed_module(), SPEC))
    assert shown.startswith("LatentAction(TensorDictModule, latent_key='latent', action_key=")
