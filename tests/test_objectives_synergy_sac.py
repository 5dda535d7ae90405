"""SynergySACLoss: the checks of a loss, its keys, and how its networks connect."""

# ruff: noqa: RUF012  (class attributes that configure a check list are constants)

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict, assert_close
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ValueOperator

from tests.loss_checks import SEED, LossChecks
from torchrl_etl.modules import SynergyDecoder, SynergyMap, make_actor, make_critic
from torchrl_etl.objectives import SynergySACLoss

OBSERVATION, SYNERGIES, ACTION, GAMMA = 3, 2, 5, 0.9
NETWORK = {"hidden": (16, 16)}


def make_loss(*, nested: bool = False, residual: float = 0.0, **kwargs: Any) -> SynergySACLoss:
    def at(name: str) -> Any:
        return ("agent", name) if nested else name

    decoder = SynergyDecoder(
        SYNERGIES,
        ACTION,
        hidden=(16,),
        residual=residual,
        in_keys=[at("synergy")],
        out_keys=[at("action")],
    )
    spec = decoder.synergy_spec
    loss = SynergySACLoss(
        make_actor({at("observation"): OBSERVATION}, spec, out_key=at("synergy"), **NETWORK),
        make_critic({at("observation"): OBSERVATION, at("action"): ACTION}, **NETWORK),
        decoder,
        action_spec=spec,
        **kwargs,
    )
    if nested:
        loss.set_keys(**{name: at(name) for name in ("reward", "done", "terminated")})
    loss.make_value_estimator(gamma=GAMMA)
    return loss


def make_data(batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
    observation, following = torch.randn(2, *batch, OBSERVATION)
    root = {"observation": observation, "action": 2 * torch.rand(*batch, ACTION) - 1}
    terminated = torch.rand(*batch, 1) < 0.3
    after = {
        "observation": following,
        "reward": torch.randn(*batch, 1),
        "done": terminated | (torch.rand(*batch, 1) < 0.2),
        "terminated": terminated,
    }
    if nested:
        root, after = {"agent": root}, {"agent": after}
    return TensorDict(root | {"next": after}, batch)


class TestSynergySACLoss(LossChecks):
    default_keys = {
        "action": "synergy",
        "reward": "reward",
        "done": "done",
        "terminated": "terminated",
        "value": "state_value",
        "state_action_value": "state_action_value",
        "priority": "td_error",
    }
    trained = {
        "loss_actor": {"actor_network_params", "decoder_network_params"},
        "loss_qvalue": {"qvalue_network_params"},
        "loss_alpha": {"log_alpha"},
    }
    targets = {"target_qvalue_network_params"}
    recorded = {("next", "observation"), ("next", "reward")}
    # The value estimator reads done only if terminated is missing.
    optional_keys = {("next", "done"), ("next", "terminated")}
    written = {"td_error"}  # priorities, as in every TorchRL loss on Q-values
    kept = {"log_alpha"}
    options: dict[str, Any] = {}

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> SynergySACLoss:
        return make_loss(nested=nested, **self.options | kwargs)

    def make_data(self, batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
        return make_data(batch, nested=nested)


class TestFrozenDecoder(TestSynergySACLoss):
    options = {"train_decoder": False}
    trained = TestSynergySACLoss.trained | {"loss_actor": {"actor_network_params"}}


class TestWithResidual(TestSynergySACLoss):
    options = {"residual": 0.3}


class TestWithoutVmap(TestSynergySACLoss):
    options = {"deactivate_vmap": True}


# Keys and connections


def test_in_keys_have_a_fixed_order() -> None:
    following = [("next", key) for key in ("observation", "reward", "done", "terminated")]
    assert make_loss().in_keys == ["observation", "action", *following]


def test_action_key_does_not_change_the_losses() -> None:
    loss, data = make_loss(), make_data()
    outs = []
    for key in ("synergy", ("fresh", "coefficients")):
        loss.set_keys(action=key)
        torch.manual_seed(SEED)
        outs.append(loss(data))
    assert_close(*outs)


def test_action_key_that_the_critic_reads_is_refused() -> None:
    with pytest.raises(ValueError, match="replayed and fresh actions would be confused"):
        make_loss().set_keys(action="action")
    decoder = SynergyDecoder(SYNERGIES, ACTION)
    with pytest.raises(ValueError, match=r"writes its sample to 'synergy', which the critic reads"):
        SynergySACLoss(
            make_actor({"observation": 3}, decoder.synergy_spec, out_key="synergy"),
            make_critic({"synergy": SYNERGIES, "action": ACTION}),
            decoder,
        )


@pytest.mark.parametrize(
    ("keys", "sample", "reads"),
    [
        ({"in_keys": ["z"]}, "synergy", "action"),
        ({}, "action", "action"),
        ({}, "synergy", "muscles"),
        ({"in_keys": ["loc"]}, "synergy", "action"),  # written by the actor, but not its sample
    ],
)
def test_decoder_that_does_not_connect_actor_and_critic_is_refused(
    keys: dict[str, Any], sample: str, reads: str
) -> None:
    decoder = SynergyDecoder(SYNERGIES, ACTION, **keys)
    with pytest.raises(ValueError, match=r"The decoder maps .* input must be the actor's sample"):
        SynergySACLoss(
            make_actor({"observation": 3}, decoder.synergy_spec, out_key=sample),
            make_critic({"observation": 3, reads: ACTION}),
            decoder,
        )


def test_invalid_decoders_and_value_networks_are_refused() -> None:
    loss = make_loss()
    actor, critic = loss.actor_network, loss.qvalue_network
    two = SynergyMap(lambda x, y: x, in_keys=["synergy", "observation"], out_keys=["action"])
    with pytest.raises(ValueError, match="The decoder maps"):
        SynergySACLoss(actor, critic, two)
    plain = TensorDictModule(nn.Linear(2, 5), in_keys=["synergy"], out_keys=["action"])
    with pytest.raises(TypeError, match="decoder is a TensorDictModule; pass a SynergyMap"):
        SynergySACLoss(actor, critic, plain)
    value = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    with pytest.raises(TypeError, match="value_network is given"):
        SynergySACLoss(actor, critic, loss.decoder_network, value_network=value)
