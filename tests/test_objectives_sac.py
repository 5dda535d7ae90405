"""LeanSACLoss: the check list, and TorchRL's own SACLoss number for number."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from tests import test_objectives_synergy_sac as synergy
from tests.loss_checks import SEED
from torchrl_etl.modules import StateEncoder, make_actor, make_critic
from torchrl_etl.objectives import BehavioralMetricLoss, FusedSoftUpdate, LeanSACLoss

OBSERVATION, ACTION, GAMMA = 3, 5, 0.9


def make_loss(
    kind: type[SACLoss] = LeanSACLoss,
    *,
    nested: bool = False,
    hidden: int = 16,
    bins: int = 1,
    **kwargs: Any,
) -> SACLoss:
    def at(name: str) -> Any:
        return ("agent", name) if nested else name

    spec = Bounded(0.0, 1.0, shape=(ACTION,))
    network = {"hidden": (hidden, hidden)}
    loss = kind(
        make_actor({at("observation"): OBSERVATION}, spec, out_key=at("action"), **network),
        make_critic({at("observation"): OBSERVATION, at("action"): ACTION}, bins=bins, **network),
        **{"target_entropy": -1.0, **kwargs},
    )
    if nested:
        loss.set_keys(**{name: at(name) for name in ("reward", "done", "terminated")})
    loss.make_value_estimator(gamma=GAMMA)
    return loss


class TestLeanSACLoss(synergy.TestSynergySACLoss):
    default_keys = synergy.TestSynergySACLoss.default_keys | {"action": "action"}
    trained = synergy.TestSynergySACLoss.trained | {"loss_actor": {"actor_network_params"}}

    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> LeanSACLoss:
        return make_loss(nested=nested, **kwargs)


@pytest.mark.parametrize(
    "options",
    [
        {"loss_function": "smooth_l1"},
        {"loss_function": "l2", "alpha_init": 0.3, "num_qvalue_nets": 3},
        {"loss_function": "l1", "fixed_alpha": True, "delay_qvalue": False, "reduction": "sum"},
        {
            "loss_function": "l2",
            "reduction": "none",
            "scalar_output_mode": "exclude",
            "min_alpha": 0.5,
            "max_alpha": 2.0,
        },
    ],
)
def test_values_and_gradients_are_those_of_torchrls_loss(options: dict[str, Any]) -> None:
    torch.manual_seed(SEED)
    theirs, ours = make_loss(SACLoss, **options), make_loss(**options)
    if options.get("delay_qvalue", True):
        for loss in (theirs, ours):
            SoftUpdate(loss, tau=0.1)
    with torch.no_grad():
        for tensor in (*theirs.parameters(), *theirs.buffers()):
            if tensor.is_floating_point() and tensor.ndim > 1:
                tensor.add_(0.3 * torch.randn_like(tensor))  # targets differ from critics
    ours.load_state_dict(theirs.state_dict())
    data = TestLeanSACLoss().data((32,))
    outs = []
    for loss in (theirs, ours):
        batch = data.clone()
        torch.manual_seed(SEED)
        out = loss(batch)
        sum(out[key].sum() for key in out.keys() if key.startswith("loss_")).backward()
        outs.append(out.detach().set("td_error", batch["td_error"]))
    assert set(outs[0].keys()) == set(outs[1].keys())
    for key, value in outs[0].items():
        torch.testing.assert_close(outs[1][key], value, msg=key)
    gradients = [dict(loss.named_parameters()) for loss in (theirs, ours)]
    for name, parameter in gradients[0].items():
        if parameter.grad is not None:
            torch.testing.assert_close(gradients[1][name].grad, parameter.grad, msg=name)
        else:
            assert gradients[1][name].grad is None, name


def test_what_it_cannot_do_is_refused() -> None:
    loss = make_loss()
    actor, critic = loss.actor_network, loss.qvalue_network
    with pytest.raises(TypeError, match="skip_done_states is given"):
        LeanSACLoss(actor, critic, skip_done_states=True)
    value = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    with pytest.raises(TypeError, match="value_network is given"):
        LeanSACLoss(actor, critic, value_network=value)
    with pytest.raises(TypeError, match="qvalue_network is a Linear"):
        LeanSACLoss(actor, nn.Linear(2, 5))


@pytest.mark.parametrize("rate", [{"tau": 0.1}, {"eps": 0.9}])
def test_targets_move_as_with_torchrls_updater(rate: dict[str, float]) -> None:
    def moved(kind: type[SoftUpdate]) -> TensorDict:
        torch.manual_seed(SEED)
        loss = BehavioralMetricLoss(StateEncoder(4, 2, hidden=(8, 8)))
        updater = kind(loss, **rate)
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.add_(torch.randn_like(parameter))
        updater.step(), updater.step()
        return loss.state_dict()

    theirs, ours = moved(SoftUpdate), moved(FusedSoftUpdate)
    assert any(key.startswith("target_") for key in ours)
    for key, value in theirs.items():
        torch.testing.assert_close(ours[key], value)


@pytest.mark.parametrize(
    ("options", "fixed_point"), [({}, 10.0), ({"loss_function": "smooth_l1"}, 1 / 9)]
)
def test_a_critic_of_terminal_transitions_has_the_fixed_point_of_its_loss_function(
    options: dict[str, Any], fixed_point: float
) -> None:
    """One in ten pays 100: the mean is 10; smooth-L1's minimum is where 9 q = 1."""
    torch.manual_seed(SEED)
    loss = make_loss(**options)
    SoftUpdate(loss, tau=0.1)
    data = TestLeanSACLoss().data((1,)).expand(10).clone()
    data["next", "reward"] = 100.0 * (torch.arange(10) == 0).float().unsqueeze(-1)
    data["next", "done"] = data["next", "terminated"] = torch.ones(10, 1, dtype=torch.bool)
    optimizer = torch.optim.Adam(loss.qvalue_network_params.parameters(), lr=0.01)
    for _ in range(800):
        optimizer.zero_grad()
        loss.qvalue_v2_loss(data)[0].backward()
        optimizer.step()
    with torch.no_grad():
        values = loss._outputs(data, loss._weights("qvalue_network"))
    torch.testing.assert_close(values, torch.full_like(values, fixed_point), rtol=0.02, atol=0.01)


def test_squared_error_is_the_square_itself_summed_over_critics() -> None:
    """Stable-Baselines3 takes half of it."""
    loss = make_loss()
    SoftUpdate(loss, tau=0.1)
    data = TestLeanSACLoss().data((4,))
    data["next", "done"] = data["next", "terminated"] = torch.ones(4, 1, dtype=torch.bool)
    values = loss._outputs(data, loss._weights("qvalue_network")).squeeze(-1)
    error = values - data["next", "reward"].squeeze(-1)
    torch.testing.assert_close(loss(data)["loss_qvalue"], error.square().mean(1).sum())


def test_unknown_loss_function_is_refused() -> None:
    with pytest.raises(ValueError, match="loss_function is 'huber'; choose one of l2, l1"):
        make_loss(loss_function="huber")
