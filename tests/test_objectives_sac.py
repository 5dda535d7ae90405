"""LeanSACLoss: the checks of a loss, and the values and gradients of TorchRL's SACLoss."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from tests import test_objectives_synergy_sac as synergy
from tests.loss_checks import SEED
from torchrl_etl.modules import StateEncoder, make_actor, make_critic
from torchrl_etl.objectives import BehavioralMetricLoss, FusedSoftUpdate, LeanSACLoss

OBSERVATION, ACTION, GAMMA = 3, 5, 0.9


def make_loss(
    kind: type[SACLoss] = LeanSACLoss,
    *,
    nested: bool = False,
    make_actor: Callable[..., ProbabilisticActor] = make_actor,
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
def test_values_and_gradients_equal_torchrls_loss(options: dict[str, Any]) -> None:
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


def test_unsupported_arguments_are_refused() -> None:
    loss = make_loss()
    actor, critic = loss.actor_network, loss.qvalue_network
    with pytest.raises(TypeError, match="skip_done_states is given"):
        LeanSACLoss(actor, critic, skip_done_states=True)
    value = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    with pytest.raises(TypeError, match="value_network is given"):
        LeanSACLoss(actor, critic, value_network=value)
    with pytest.raises(TypeError, match="qvalue_network is a Linear"):
        LeanSACLoss(actor, nn.Linear(2, 5))
    with pytest.raises(TypeError, match="actor_network is a Linear"):
        LeanSACLoss(nn.Linear(2, 5), critic)


def test_support_with_multi_step_value_estimators_is_refused() -> None:
    loss = make_loss(bins=11, support=torch.linspace(-5.0, 5.0, 11))
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    for kind in (ValueEstimators.TD1, ValueEstimators.TDLambda):
        with pytest.raises(ValueError, match="targets with a support are one-step"):
            loss.make_value_estimator(kind, gamma=GAMMA)


@pytest.mark.parametrize(("bins", "entries"), [(11, None), (1, 11), (7, 11)])
def test_critic_size_that_differs_from_the_support_is_refused(
    bins: int, entries: int | None
) -> None:
    support = None if entries is None else torch.linspace(-5.0, 5.0, entries)
    words = rf"last size of {bins} but the support has {entries or 1} bins \(1 means no support\)"
    with pytest.raises(ValueError, match=words):
        make_loss(bins=bins, support=support)(TestLeanSACLoss().make_data())


class Value(nn.Module):
    """Q-values [*, 1] of an action in one or two parts, with further outputs if asked for."""

    def __init__(self, *, outputs: int = 1) -> None:
        super().__init__()
        self.layer = nn.Linear(OBSERVATION + ACTION, outputs)

    def forward(self, state: Any, move: Any) -> Any:
        if isinstance(move, TensorDict):
            move = torch.cat([move["left"], move["right"]], -1)
        values = self.layer(torch.cat([state, move], -1)).unbind(-1)
        values = tuple(value.unsqueeze(-1) for value in values)
        return values if len(values) > 1 else values[0]


def sequence() -> TensorDictSequential:
    return TensorDictSequential(
        TensorDictModule(nn.Linear(OBSERVATION, 4), ["observation"], ["hidden"]),
        TensorDictModule(nn.Linear(4, OBSERVATION), ["hidden"], ["features"]),
        TensorDictModule(Value(), ["features", "action"], ["state_action_value"]),
    )


def two_outputs() -> TensorDictModule:
    outputs = ["beside", "state_action_value"]
    return TensorDictModule(Value(outputs=2), ["observation", "action"], outputs)


def keyword_inputs() -> TensorDictModule:
    names = {"move": "action", "state": "observation"}
    return TensorDictModule(Value(), names, ["state_action_value"])


def hooked() -> TensorDictModule:
    critic = TensorDictModule(Value(), ["observation", "action"], ["state_action_value"])
    critic.register_forward_hook(lambda _, __, out: out.apply(lambda value: 2 * value))
    return critic


def composite_actor(**parts: Any) -> ProbabilisticActor:
    """An actor of two parts of an action, "left" [*, 2] and "right" [*, 3]."""

    class Parameters(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Sequential(nn.Linear(OBSERVATION, 2 * ACTION), NormalParamExtractor())

        def forward(self, observation: Any) -> Any:
            loc, scale = self.net(observation)
            return loc[..., :2], scale[..., :2], loc[..., 2:], scale[..., 2:]

    sides = [("params", side, name) for side in ("left", "right") for name in ("loc", "scale")]
    maps = {"distribution_map": {"left": TanhNormal, "right": TanhNormal}, **parts}
    return ProbabilisticActor(
        TensorDictModule(Parameters(), ["observation"], sides),
        in_keys=["params"],
        out_keys=list(parts.get("name_map", {"action": None})),
        distribution_class=partial(CompositeDistribution, **maps),
    )


def assert_same_numbers(actor: Any, critic: Any, data: TensorDict) -> None:
    outs = []
    for kind in (SACLoss, LeanSACLoss):
        options = {"target_entropy": -1.0, "loss_function": "l2"}
        torch.manual_seed(SEED)
        loss = kind(deepcopy(actor), deepcopy(critic), **options)
        SoftUpdate(loss, tau=0.1)
        torch.manual_seed(SEED)
        batch = data.clone()
        out = loss(batch)
        if kind is LeanSACLoss:  # TorchRL's also writes loc and scale
            assert set(batch.keys(True)) == {*data.keys(True), "td_error"}
        sum(out[key] for key in out.keys() if key.startswith("loss_")).backward()
        gradients = {k: v.grad for k, v in loss.named_parameters() if v.grad is not None}
        outs.append(({k: v.detach() for k, v in out.items()}, gradients))
    (theirs, their_gradients), (ours, our_gradients) = outs
    torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(our_gradients, their_gradients)


@pytest.mark.parametrize("make", [sequence, two_outputs, keyword_inputs, hooked])
def test_custom_critics_give_the_values_of_torchrls_loss(make: Any) -> None:
    actor = make_loss().actor_network
    torch.manual_seed(SEED)
    assert_same_numbers(actor, make(), TestLeanSACLoss().data((8,)))


def test_composite_action_under_one_key_gives_the_values_of_torchrls_loss() -> None:
    torch.manual_seed(SEED)
    data = TestLeanSACLoss().data((8,))
    left, right = data["action"].split([2, 3], -1)
    data["action"] = TensorDict({"left": left, "right": right}, [8])
    critic = TensorDictModule(Value(), ["observation", "action"], ["state_action_value"])
    assert_same_numbers(composite_actor(), critic, data)


def test_entropy_dims_require_a_tanh_gaussian_actor() -> None:
    with pytest.raises(ValueError, match="entropy_dims is 1, but the actor is not a tanh-Gaussian"):
        LeanSACLoss(composite_actor(), make_critic({"observation": 3, "action": 2}), entropy_dims=1)


def test_composite_action_under_several_keys_is_refused() -> None:
    actor = composite_actor(name_map={"left": "left", "right": "right"})
    with pytest.raises(ValueError, match=r"The actor samples \['left', 'right'\]"):
        LeanSACLoss(actor, keyword_inputs())


def test_critic_with_several_outputs_must_write_the_value_key() -> None:
    actor, critic = make_loss().actor_network, two_outputs()
    loss = LeanSACLoss(actor, critic, target_entropy=-1.0)
    with pytest.raises(ValueError, match="one of them must be 'q'"):
        loss.set_keys(state_action_value="q")
    loss.set_keys(state_action_value="beside")
    critic.out_keys = ["first", "second"]
    with pytest.raises(ValueError, match="one of them must be 'state_action_value'"):
        LeanSACLoss(actor, critic, target_entropy=-1.0)


@pytest.mark.parametrize("rate", [{"tau": 0.1}, {"eps": 0.9}])
def test_fused_soft_update_equals_torchrls_soft_update(rate: dict[str, float]) -> None:
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
def test_critic_of_terminal_transitions_converges_to_the_minimum(
    options: dict[str, Any], fixed_point: float
) -> None:
    """One of ten rewards is 100: squared error has its minimum at 10, smooth L1 where 9 q = 1."""
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


def test_squared_error_has_no_factor_half_and_sums_over_critics() -> None:
    """Stable-Baselines3 has a factor 1/2."""
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
