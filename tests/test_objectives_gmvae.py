"""GMVAELoss: the checks of a loss, its terms, and training."""

# ruff: noqa: RUF012  (class attributes that configure a check list are constants)

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.loss_checks import LossChecks
from torchrl_etl.modules import GMVAE
from torchrl_etl.objectives import GMVAELoss

ACTION_DIM, LATENT_DIM = 6, 2


class TestGMVAELoss(LossChecks):
    default_keys = {"action": "action"}
    trained = {"loss_gmvae": {"gmvae_params"}}
    recorded = {"action"}
    components = 3

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> GMVAELoss:
        loss = GMVAELoss(GMVAE(ACTION_DIM, LATENT_DIM, self.components, hidden=(16,)), **kwargs)
        if nested:
            loss.set_keys(action=("agent", "action"))
        return loss

    def make_data(self, batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
        action = 2 * torch.rand(*batch, ACTION_DIM) - 1
        return TensorDict({"agent": {"action": action}} if nested else {"action": action}, batch)


class TestVAELoss(TestGMVAELoss):
    """The unimodal ablation."""

    components = 1


def actions(batch: int = 64) -> TensorDict:
    return TensorDict({"action": 2 * torch.rand(batch, ACTION_DIM) - 1}, [batch])


def test_loss_is_the_weighted_sum_of_its_terms() -> None:
    gmvae, data = GMVAE(ACTION_DIM, LATENT_DIM), actions()
    for kl_weight, component_kl_weight in ((1.0, 1.0), (0.5, 2.0), (0.0, 0.0)):
        loss = GMVAELoss(gmvae, kl_weight=kl_weight, component_kl_weight=component_kl_weight)
        out = loss(data)
        expected = (
            kl_weight * out["latent_kl"]
            + component_kl_weight * out["component_kl"]
            - out["reconstruction"]
        )
        torch.testing.assert_close(out["loss_gmvae"].detach(), expected)


def test_action_units_do_not_change_the_loss() -> None:
    signed = GMVAE(ACTION_DIM, LATENT_DIM)
    unsigned = GMVAE(ACTION_DIM, LATENT_DIM, low=0.0, high=1.0)
    weights = {
        k: v for k, v in signed.state_dict().items() if k.split(".")[-1] not in ("low", "high")
    }
    unsigned.load_state_dict(weights, strict=False)
    data = actions()
    rescaled = TensorDict({"action": (data["action"] + 1) / 2}, data.batch_size)
    values = []
    for gmvae, batch in ((signed, data), (unsigned, rescaled)):
        torch.manual_seed(1)
        values.append(GMVAELoss(gmvae)(batch)["loss_gmvae"])
    torch.testing.assert_close(*values)


def test_actions_in_double_precision_have_the_loss_of_single_precision() -> None:
    loss, action = GMVAELoss(GMVAE(4, 2)), torch.rand(8, 4)
    values = []
    for each in (action, action.double()):
        torch.manual_seed(0)
        values.append(loss(TensorDict({"action": each}, [8]))["loss_gmvae"])
    assert torch.equal(*values)


def test_latents_are_sampled_inside_the_loss() -> None:
    # TorchRL turns exploration off inside losses, but a VAE must sample its latents.
    loss, data = GMVAELoss(GMVAE(ACTION_DIM, LATENT_DIM)), actions()
    assert loss(data)["loss_gmvae"] != loss(data)["loss_gmvae"]


def test_component_entropy_distinguishes_collapse_from_even_use() -> None:
    gmvae = GMVAE(ACTION_DIM, LATENT_DIM, 4, hidden=(8,))
    head = [module for module in gmvae.encoder.modules() if isinstance(module, nn.Linear)][-1]
    nn.init.zeros_(head.weight), nn.init.zeros_(head.bias)
    loss = GMVAELoss(gmvae)
    even = loss(actions())
    assert even["component_entropy"].item() == pytest.approx(math.log(4), rel=1e-5)
    assert even["component_kl"].item() == pytest.approx(0.0, abs=1e-6)
    head.bias.data[0] = 50.0
    collapsed = loss(actions())
    assert collapsed["component_entropy"].item() == pytest.approx(0.0, abs=1e-6)
    assert collapsed["component_kl"].item() == pytest.approx(math.log(4), rel=1e-5)


def test_training_recovers_planted_synergies() -> None:
    mixing = torch.randn(LATENT_DIM, ACTION_DIM)
    action = torch.tanh(0.7 * torch.randn(512, LATENT_DIM) @ mixing)
    gmvae = GMVAE(ACTION_DIM, LATENT_DIM, hidden=(32,))
    loss = GMVAELoss(gmvae)
    optimizer = torch.optim.Adam(loss.parameters(), 5e-3)
    data = TensorDict({"action": action}, [512])
    for _ in range(400):
        value = loss(data)["loss_gmvae"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    # The loss trains the model it was given, not a copy.
    with torch.no_grad():
        residual = (gmvae.reconstruct(action) - action).square().sum()
    assert 1 - residual / (action - action.mean(0)).square().sum() > 0.8


def test_reset_parameters_redraws_the_prior() -> None:
    loss = GMVAELoss(GMVAE(ACTION_DIM, LATENT_DIM, low=0.0, high=2.0))
    before = loss.gmvae_params["prior_loc"].detach().clone()
    loss.reset_parameters_recursive()
    assert (loss.gmvae_params["prior_loc"] != before).all()
    assert (loss.gmvae_params["decoder", "high"] == 2.0).all()


def test_wrong_arguments_are_refused_at_construction() -> None:
    with pytest.raises(TypeError, match="gmvae is a Linear; pass a GMVAE"):
        GMVAELoss(nn.Linear(2, 2))
    with pytest.raises(ValueError, match=r"kl_weight is -1.0; it must be a number 0 or more"):
        GMVAELoss(GMVAE(ACTION_DIM, LATENT_DIM), kl_weight=-1.0)
