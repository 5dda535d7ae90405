"""DecoderLoss: the checks of a loss, and the gradient of Eq. 10 on fresh and stale pairs."""

# ruff: noqa: RUF012  (class attributes that configure a check list are constants)

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from tests.loss_checks import LossChecks
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.objectives import DecoderLoss

SYNERGIES, ACTION_DIM = 2, 5


class TestDecoderLoss(LossChecks):
    default_keys = {"synergy": "synergy", "action": "action"}
    trained = {"loss_decoder": {"decoder_params"}}
    recorded = {"synergy", "action"}
    residual = 0.0

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> DecoderLoss:
        decoder = SynergyDecoder(SYNERGIES, ACTION_DIM, hidden=(16,), residual=self.residual)
        loss = DecoderLoss(decoder, **kwargs)
        if nested:
            loss.set_keys(synergy=("agent", "synergy"), action=("agent", "action"))
        return loss

    def make_data(self, batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
        size = SYNERGIES + (ACTION_DIM if self.residual else 0)
        entries = {
            "synergy": 2 * torch.rand(*batch, size) - 1,
            "action": 2 * torch.rand(*batch, ACTION_DIM) - 1,
        }
        return TensorDict({"agent": TensorDict(entries, batch)} if nested else entries, batch)


class TestDecoderLossWithResidual(TestDecoderLoss):
    residual = 0.3


def test_loss_by_hand() -> None:
    network = nn.Linear(1, 2, bias=False)
    network.weight.data = torch.tensor([[1.0], [2.0]])
    decoder = TensorDictModule(network, in_keys=["z"], out_keys=["muscles"])
    data = TensorDict(
        {"synergy": torch.tensor([[1.0], [2.0]]), "action": torch.tensor([[0.0, 0.0], [2.0, 1.0]])},
        [2],
    )
    # (1, 2) against (0, 0) and (2, 4) against (2, 1).
    assert DecoderLoss(decoder)(data)["loss_decoder"].item() == pytest.approx((5 + 9) / 2)


def test_fresh_pairs_give_no_gradient_and_stale_pairs_undo_drift() -> None:
    decoder = SynergyDecoder(SYNERGIES, ACTION_DIM, hidden=(16,))
    data = TensorDict({"synergy": 2 * torch.rand(64, SYNERGIES) - 1}, [64])
    with torch.no_grad():
        data = decoder(data)
    loss = DecoderLoss(decoder)
    fresh = loss(data)["loss_decoder"]
    fresh.backward()
    assert fresh.item() == pytest.approx(0.0, abs=1e-10)
    assert all(parameter.grad.abs().max() < 1e-6 for parameter in loss.parameters())

    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    drifted = loss(data)["loss_decoder"].item()
    for _ in range(50):
        value = loss(data)["loss_decoder"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    assert loss(data)["loss_decoder"].item() < 0.1 * drifted


def test_plain_networks_are_refused() -> None:
    with pytest.raises(TypeError, match="decoder is a Linear"):
        DecoderLoss(nn.Linear(2, 2))
