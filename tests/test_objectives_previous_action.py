"""Losses warn of keys that pair a synergy with the action of the previous step."""

from __future__ import annotations

import warnings

import pytest

from torchrl_etl.modules import SynergyDecoder, make_actor, make_critic
from torchrl_etl.objectives import DecoderLoss, SynergySACLoss


def decoder_loss(key):
    DecoderLoss(SynergyDecoder(2, 4)).set_keys(action=key)


def sac_loss(key):
    decoder = SynergyDecoder(2, 4, out_keys=[key])
    SynergySACLoss(
        make_actor({"observation": 3}, decoder.synergy_spec, out_key="synergy"),
        make_critic({"observation": 3, key: 4}),
        decoder,
        action_spec=decoder.synergy_spec,
    )


@pytest.mark.parametrize("make", [decoder_loss, sac_loss])
def test_root_executed_action_warns(make):
    with pytest.warns(UserWarning, match="'executed_action' at the root"):
        make("executed_action")


@pytest.mark.parametrize(
    ("make", "key"),
    [(decoder_loss, "action"), (decoder_loss, ("next", "executed_action")), (sac_loss, "action")],
)
def test_action_of_the_same_step_does_not_warn(make, key):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        make(key)
