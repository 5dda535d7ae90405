"""SynergySACLoss: the action that each part reads, against losses composed by hand."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import cloudpickle
import pytest
import torch
from tensordict import TensorDict, assert_close
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SoftUpdate

from tests.loss_checks import SEED
from tests.test_objectives_synergy_sac import ACTION, GAMMA, SYNERGIES, make_data, make_loss
from torchrl_etl.modules import SynergyMap
from torchrl_etl.objectives import SynergySACLoss

# The expected losses, composed by hand from the networks.


def fresh_synergy(loss: SynergySACLoss, data: TensorDict) -> tuple[Tensor, Tensor]:
    """The sample that the loss draws from the same seed, and its log-probability as an action."""
    distribution = loss.get_stateful_net("actor_network").get_dist(data.clone())
    torch.manual_seed(SEED)
    synergy, log_prob = distribution.rsample_and_log_prob()
    if share := loss.decoder_network.residual:
        # tanh⁻¹a = tanh⁻¹b + tanh⁻¹(ρr), hence ∂a/∂(ρr) = (1 - a²) / (1 - (ρr)²).
        action, residual = action_of(loss, synergy), share * synergy[..., SYNERGIES:]
        slope = (1 - action.square()) / (1 - residual.square())
        log_prob = log_prob - slope.log().sum(-1)
    return synergy, log_prob


def action_of(loss: SynergySACLoss, synergy: Tensor) -> Tensor:
    """Decode with the decoder's parameters, which an optimizer updates."""
    return loss.decoder_network.module(synergy)


def critics_of(loss: SynergySACLoss, params: Any, observation: Tensor, action: Tensor) -> Tensor:
    """Values [num critics, *]."""
    network = loss.qvalue_network.module
    inputs = torch.cat([observation, action], -1)
    values = []
    for one in params.unbind(0):
        weights = {k: v.detach() for k, v in one["module"].flatten_keys(".").items()}
        values.append(functional_call(network, weights, (inputs,)).squeeze(-1))
    return torch.stack(values)


def expected_actor_loss(loss: SynergySACLoss, data: TensorDict) -> Tensor:
    synergy, log_prob = fresh_synergy(loss, data)
    values = critics_of(
        loss, loss.qvalue_network_params, data["observation"], action_of(loss, synergy)
    )
    return (loss.log_alpha.exp().detach() * log_prob - values.amin(0)).mean()


@torch.no_grad()
def expected_qvalue_loss(loss: SynergySACLoss, data: TensorDict) -> Tensor:
    synergy, log_prob = fresh_synergy(loss, data["next"].select("observation"))
    following = critics_of(
        loss,
        loss.target_qvalue_network_params,
        data["next", "observation"],
        action_of(loss, synergy),
    )
    bootstrap = following.amin(0) - loss.log_alpha.exp() * log_prob
    alive = ~data["next", "terminated"].squeeze(-1)
    target = data["next", "reward"].squeeze(-1) + GAMMA * alive * bootstrap
    predicted = critics_of(loss, loss.qvalue_network_params, data["observation"], data["action"])
    return (predicted - target).square().sum(0).mean()


def seeded(function: Any, *args: Any) -> Any:
    torch.manual_seed(SEED)
    return function(*args)


def move(params: Any, by: float = 0.5) -> None:
    with torch.no_grad():
        for value in params.values(True, True):
            if value.requires_grad:
                value.add_(by * torch.randn_like(value))


@pytest.fixture(params=[0.0, 0.3], ids=["synergies", "residual"])
def loss(request: pytest.FixtureRequest) -> SynergySACLoss:
    loss = make_loss(loss_function="l2", alpha_init=0.3, residual=request.param)
    SoftUpdate(loss, tau=0.1)
    move(loss.target_qvalue_network_params.apply(lambda x: x.requires_grad_(False)))
    return loss


@pytest.fixture
def data() -> TensorDict:
    torch.manual_seed(1)
    return make_data((16,))


def qvalue_loss(loss: SynergySACLoss, data: TensorDict) -> Tensor:
    return seeded(loss.qvalue_v2_loss, data)[0]


def actor_loss(loss: SynergySACLoss, data: TensorDict) -> Tensor:
    return seeded(loss.actor_loss, data)[0]


def test_both_losses_use_the_current_decoder(loss, data) -> None:
    seen = []
    for _ in range(2):
        actor, qvalue = actor_loss(loss, data), qvalue_loss(loss, data)
        torch.testing.assert_close(actor, expected_actor_loss(loss, data))
        torch.testing.assert_close(qvalue, expected_qvalue_loss(loss, data))
        seen.append((actor.item(), qvalue.item()))
        move(loss.decoder_network_params)
    assert seen[0][0] != seen[1][0] and seen[0][1] != seen[1][1]


def test_entropy_dims_limit_the_entropy_to_the_coefficients(data) -> None:
    loss = make_loss(residual=0.5, entropy_dims=SYNERGIES)
    distribution = loss.get_stateful_net("actor_network").get_dist(data.clone())
    loc, scale = (part[..., :SYNERGIES] for part in (distribution.loc, distribution.scale))
    synergy, log_prob = seeded(loss._sample, data)
    wanted = TanhNormal(loc, scale, low=-1, high=1).log_prob(synergy[..., :SYNERGIES])
    torch.testing.assert_close(log_prob, wanted)


def test_a_replayed_transition_is_valued_at_its_executed_action(loss, data) -> None:
    data["synergy"] = torch.rand(16, SYNERGIES)  # as in a buffer: not the code of the action
    data["next", "terminated"][:] = True  # no bootstrap: what is left is Q(s, a) - r
    before = qvalue_loss(loss, data)
    move(loss.decoder_network_params)
    assert torch.equal(qvalue_loss(loss, data), before)
    data["synergy"] = -data["synergy"]
    assert torch.equal(qvalue_loss(loss, data), before)
    data["action"] = data["action"].roll(1, 0)
    assert (qvalue_loss(loss, data) - before).abs() > 1e-4


def test_stale_actions_in_the_data_do_not_change_the_losses(loss, data) -> None:
    before, actor = qvalue_loss(loss, data), actor_loss(loss, data)
    planted = data.clone()
    planted["next", "executed_action"] = torch.full((16, ACTION), 100.0)
    planted["next", "action"] = torch.full((16, ACTION), 100.0)
    planted["next", "synergy"] = torch.full((16, SYNERGIES), 100.0)
    planted["executed_action"] = torch.full((16, ACTION), 100.0)
    planted["synergy"] = torch.full((16, SYNERGIES), 100.0)
    assert torch.equal(qvalue_loss(loss, planted), before)
    assert torch.equal(actor_loss(loss, planted), actor)


def test_actor_gradient_equals_the_explicit_composition(loss, data) -> None:
    decoder = list(loss.decoder_network.parameters())
    names, actor = zip(*loss.actor_network.named_parameters(), strict=True)
    reached = torch.autograd.grad(actor_loss(loss, data), [*actor, *decoder])

    synergy, log_prob = fresh_synergy(loss, data)
    synergy.retain_grad()
    values = critics_of(
        loss, loss.qvalue_network_params, data["observation"], action_of(loss, synergy)
    )
    expected = torch.autograd.grad(
        (loss.log_alpha.exp().detach() * log_prob - values.amin(0)).mean(), decoder
    )
    for ours, theirs in zip(reached[len(names) :], expected, strict=True):
        assert theirs.abs().sum() > 0
        torch.testing.assert_close(ours, theirs)

    loss.train_decoder = False
    frozen = torch.autograd.grad(
        actor_loss(loss, data), [*actor, *decoder], allow_unused=True, materialize_grads=False
    )
    assert all(gradient is None for gradient in frozen[len(names) :])
    # The gradient of the actor is the same with a frozen decoder.
    for ours, theirs in zip(frozen[: len(names)], reached[: len(names)], strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("train_decoder", [True, False])
def test_critic_loss_leaves_the_callers_decoder_unchanged(train_decoder: bool, data) -> None:
    loss = make_loss(train_decoder=train_decoder)
    decoder = loss.decoder_network
    parameters = dict(decoder.named_parameters())
    before = {key: value.clone() for key, value in decoder.state_dict().items()}
    loss(data)["loss_qvalue"].backward()
    after = dict(decoder.named_parameters())
    assert all(after[name] is parameter for name, parameter in parameters.items())
    assert all(p.requires_grad and p.grad is None for p in parameters.values())
    assert all(torch.equal(value, before[key]) for key, value in decoder.state_dict().items())


def test_actor_loss_by_hand() -> None:
    """One synergy u drives two muscles, a = (u, 2u), under the critics 3a₁ + 4a₂ and 20 - a₂."""
    fixed = nn.Linear(1, 1)
    nn.init.constant_(fixed.weight, 2.0), nn.init.zeros_(fixed.bias)
    actor = ProbabilisticActor(
        TensorDictModule(
            lambda x: (fixed(x), torch.ones_like(x)), in_keys=["x"], out_keys=["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        out_keys=["u"],
        distribution_class=IndependentNormal,
    )
    actor.register_module("weights", fixed)  # a lambda hides them
    network = nn.Linear(1, 2, bias=False)
    network.weight.data = torch.tensor([[1.0], [2.0]])
    decoder = SynergyMap(network, in_keys=["u"], out_keys=["muscles"])

    class Linear(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.weight, self.bias = nn.Parameter(torch.randn(2)), nn.Parameter(torch.randn(1))

        def forward(self, x: Tensor, muscles: Tensor) -> Tensor:
            return (muscles * self.weight).sum(-1, keepdim=True) + self.bias

    critic = ValueOperator(Linear(), in_keys=["x", "muscles"], out_keys=["state_action_value"])
    loss = SynergySACLoss(actor, critic, decoder, target_entropy=-1.0, alpha_init=0.5)
    params = loss.qvalue_network_params["module"]
    with torch.no_grad():
        params["weight"].copy_(torch.tensor([[3.0, 4.0], [0.0, -1.0]]))
        params["bias"].copy_(torch.tensor([[0.0], [20.0]]))

    data = TensorDict({"x": torch.tensor([[0.0], [1.0]])}, [2])
    noise = seeded(torch.randn, 2, 1).squeeze(-1)
    u = torch.tensor([0.0, 2.0]) + noise
    log_prob = -0.5 * noise.square() - 0.5 * torch.log(torch.tensor(2 * torch.pi))
    # 3u + 8u against 20 - 2u.
    value = torch.minimum(11 * u, 20 - 2 * u)
    assert (
        (value[0] - 11 * u[0]).abs() < 1e-6 < (value[1] - 11 * u[1]).abs()
    )  # either critic is the smaller one once
    out = actor_loss(loss, data)
    torch.testing.assert_close(out, (0.5 * log_prob - value).mean())
    out.backward()
    # dL/dW = -mean(dQ/da · u): (3, 4) from the first sample, (0, -1) from the second.
    by_hand = -(torch.tensor([[3.0], [4.0]]) * u[0] + torch.tensor([[0.0], [-1.0]]) * u[1]) / 2
    torch.testing.assert_close(network.weight.grad, by_hand)


# Copies


def rebuilt(loss: SynergySACLoss) -> SynergySACLoss:
    """A new loss with the same state dict."""
    torch.manual_seed(99)
    other = make_loss(loss_function="l2", residual=loss.decoder_network.residual)
    SoftUpdate(other, tau=0.1)
    other.load_state_dict(loss.state_dict())
    return other


@pytest.mark.parametrize("clone", [deepcopy, lambda x: cloudpickle.loads(cloudpickle.dumps(x))])
def test_copied_loss_uses_its_own_parameters(clone: Any, loss, data) -> None:
    expected = seeded(loss, data)  # used before it is copied
    copy = clone(loss)
    assert_close(seeded(copy, data), expected)
    for params in (copy.decoder_network_params, copy.qvalue_network_params):
        move(params)
        assert_close(seeded(copy, data), seeded(rebuilt(copy), data))
        assert_close(seeded(loss, data), expected)
    sum(v for k, v in seeded(copy, data).items() if k.startswith("loss_")).backward()
    assert all(p.grad is not None for p in copy.decoder_network_params.parameters())
    assert all(parameter.grad is None for parameter in loss.parameters())


def test_the_state_dict_holds_the_decoder(loss, data) -> None:
    keys = [key for key in loss.state_dict() if key.startswith("decoder_network_params")]
    assert {key.split(".")[-1] for key in keys} >= {"weight", "bias", "center", "scale", "low"}
    assert_close(seeded(rebuilt(loss), data), seeded(loss, data))


def test_cast_to_double_after_use(loss, data) -> None:
    before = seeded(loss, data).double()
    loss.double()
    double = data.apply(lambda x: x.double() if x.is_floating_point() else x)
    assert actor_loss(loss, double).dtype == torch.float64
    torch.testing.assert_close(actor_loss(loss, double), expected_actor_loss(loss, double))
    assert set(seeded(loss, double).keys()) == set(before.keys())
