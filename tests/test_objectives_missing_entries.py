"""Losses name the entry that the data lacks and, for an action, the transform that adds it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, RenameTransform, TransformedEnv

import torchrl_etl.envs  # noqa: F401  (registers the environment)
from torchrl_etl.modules import GMVAE, StateEncoder, SynergyDecoder, make_actor, make_critic
from torchrl_etl.objectives import (
    BehavioralMetricLoss,
    DecoderLoss,
    GMVAELoss,
    METRALoss,
    SynergySACLoss,
)
from torchrl_etl.transforms import SynergyAction


def rollout(decoder: SynergyDecoder) -> TensorDict:
    return TransformedEnv(GymEnv("torchrl_etl/Overactuated-v0"), SynergyAction(decoder)).rollout(9)


def sac(decoder: SynergyDecoder) -> SynergySACLoss:
    spec = decoder.synergy_spec
    actor = make_actor({"observation": 6}, spec, out_key="synergy", hidden=(8,))
    critic = make_critic({"observation": 6, "action": 16}, hidden=(8,))
    return SynergySACLoss(actor, critic, decoder, action_spec=spec)


@pytest.mark.parametrize("make", [sac, DecoderLoss, lambda decoder: GMVAELoss(GMVAE(16, 3))])
def test_missing_action_error_names_a_transform_that_provides_it(make):
    decoder = SynergyDecoder(3, 16)
    loss, data = make(decoder), rollout(decoder)
    with pytest.raises(KeyError, match=r"reads 'action'.*; RenameTransform.* makes one"):
        loss(data)
    loss(RenameTransform([("next", "executed_action")], ["action"], create_copy=True)(data))


@pytest.mark.parametrize(
    ("make", "missing"),
    [
        (METRALoss, "direction"),
        (METRALoss, "next"),
        (BehavioralMetricLoss, ("next", "reward")),
        (BehavioralMetricLoss, ("next", "terminated")),
    ],
)
def test_missing_entry_is_named(make, missing):
    data = rollout(SynergyDecoder(3, 16)).set("direction", torch.zeros(9, 2))
    loss = make(StateEncoder(6, 2))
    loss(data)
    with pytest.raises(KeyError) as error:
        loss(data.exclude(missing))
    assert f"{make.__name__} reads {missing!r}, which the data lacks" in error.value.args[0]
