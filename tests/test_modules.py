"""Networks: bounds, shapes, densities, and a GMVAE that recovers planted synergies."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded

from torchrl_etl.baselines.dynsyn import make_dynsyn_actor
from torchrl_etl.baselines.lattice import make_lattice_actor
from torchrl_etl.envs import AnalyticOveractuated
from torchrl_etl.modules import (
    GMVAE,
    ActionDecoder,
    GaussianDynamics,
    StateEncoder,
    SynergyDecoder,
    UniformWarmup,
    make_actor,
    make_critic,
)
from torchrl_etl.objectives import GMVAELoss
from torchrl_etl.synergies import fit_gmvae

LOW, HIGH = [0.0, -1.0, -3.0, 0.1], [1.0, 1.0, 5.0, 0.7]
BOUNDS = [(0.0, 1.0), (-1.0, 1.0), (LOW, HIGH)]


def uniform(count: int, low: object = -1.0, high: object = 1.0, dim: int = 4) -> Tensor:
    low, high = torch.as_tensor(low), torch.as_tensor(high)
    return low + (high - low) * torch.rand(count, dim)


def weights(module: nn.Module) -> dict[str, Tensor]:
    return {key: value.clone() for key, value in module.state_dict().items()}


def same(one: dict[str, Tensor], two: dict[str, Tensor]) -> bool:
    return one.keys() == two.keys() and all(torch.equal(one[key], two[key]) for key in one)


def bias_of_last_layer(module: nn.Module) -> Tensor:
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)][-1].bias.data


# GMVAE


@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_decoded_actions_fill_the_bounds_and_stay_inside(low: object, high: object) -> None:
    gmvae = GMVAE(4, 2, low=low, high=high, hidden=(16,))
    wide = gmvae.decode(1000 * torch.randn(500, 2))
    low, high = (torch.as_tensor(bound).expand(4) for bound in (low, high))
    assert ((wide >= low) & (wide <= high)).all()
    torch.testing.assert_close(wide.amin(0), low, atol=0.05, rtol=0)
    torch.testing.assert_close(wide.amax(0), high, atol=0.05, rtol=0)


@pytest.mark.parametrize(("low", "high"), BOUNDS)
def test_normalize_maps_bounds_to_one_and_back(low: object, high: object) -> None:
    decoder = ActionDecoder(2, 4, low=low, high=high)
    corners = torch.stack([decoder.low, decoder.high, (decoder.low + decoder.high) / 2])
    unit = torch.tensor([[-1.0], [1.0], [0.0]]).expand(3, 4)
    torch.testing.assert_close(decoder.normalize(corners), unit, atol=1e-6, rtol=0)
    torch.testing.assert_close(decoder.denormalize(unit), corners)


def test_from_spec_takes_size_and_bounds() -> None:
    spec = Bounded(torch.tensor(LOW), torch.tensor(HIGH), shape=(4,))
    gmvae = GMVAE.from_spec(spec, 2, 3, hidden=(8,))
    assert (gmvae.action_dim, gmvae.latent_dim, gmvae.num_components) == (4, 2, 3)
    assert torch.equal(gmvae.low, torch.tensor(LOW)) and torch.equal(gmvae.high, torch.tensor(HIGH))
    for wrong in (Bounded(0, 1, shape=(16, 4)), Composite(action=spec)):
        with pytest.raises(ValueError, match=r"pass the bounded leaf of one environment"):
            GMVAE.from_spec(wrong, 2)


@pytest.mark.parametrize(
    "spec", [Unbounded((2,)), Bounded(-3e38, 3e38, shape=(2,)), Bounded(1, 1, shape=(2,))]
)
@pytest.mark.parametrize(
    "make",
    [
        lambda spec: GMVAE.from_spec(spec, 1),
        lambda spec: make_actor({"observation": 3}, spec),
        lambda spec: make_lattice_actor({"observation": 3}, spec),
        lambda spec: UniformWarmup(spec, 3),
    ],
)
def test_bounds_out_of_order_or_without_a_finite_range_are_refused(make: Any, spec: Any) -> None:
    with pytest.raises(ValueError, match="without finite, ascending bounds; pass the bounded"):
        make(spec)


def test_impossible_sizes_and_bounds_are_refused() -> None:
    with pytest.raises(ValueError, match="latent_dim is 5 but there are only 4 actuators"):
        GMVAE(4, 5)
    with pytest.raises(ValueError, match="num_components is 0"):
        GMVAE(4, 2, 0)
    with pytest.raises(ValueError, match="every lower bound must be finite and below"):
        GMVAE(4, 2, low=[0.0, 1.0, 0.0, 0.0], high=1.0)
    with pytest.raises(ValueError, match="every lower bound must be finite and below"):
        GMVAE(4, 2, low=float("-inf"))
    with pytest.raises(ValueError, match="every lower bound must be finite and below"):
        GMVAE(4, 2, low=-3e38, high=3e38)
    with pytest.raises(ValueError, match=r"shape \(2,\) but there are 4 actuators"):
        GMVAE(4, 2, low=[0.0, 0.0])


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
@pytest.mark.parametrize("components", [1, 3])
def test_shapes(batch: tuple[int, ...], components: int) -> None:
    gmvae = GMVAE(4, 2, components, hidden=(8,))
    posterior = gmvae.encode(torch.rand(*batch, 4))
    assert posterior.logits.shape == (*batch, components)
    assert posterior.loc.shape == posterior.scale.shape == (*batch, components, 2)
    assert (posterior.scale > 0).all()
    assert gmvae.infer(torch.rand(*batch, 4)).shape == (*batch, 2)
    assert gmvae.reconstruct(torch.rand(*batch, 4)).shape == (*batch, 4)
    assert gmvae.prior_loc.shape == gmvae.prior_scale.shape == (components, 2)
    assert gmvae.likelihood_scale.shape == (4,)


def test_components_default_to_the_latent_size_and_one_gives_a_vae() -> None:
    assert GMVAE(4, 3).num_components == 3
    vae = GMVAE(4, 3, 1, hidden=(8,))
    assert (vae.prior_loc == 0).all() and (vae.prior_scale == 1).all()
    action = uniform(6)
    assert torch.equal(vae.infer(action), vae.encode(action).loc[:, 0])
    assert (GMVAELoss(vae)(TensorDict({"action": action}, [6]))["component_kl"] == 0).all()


def test_infer_returns_the_mean_of_the_likeliest_component() -> None:
    gmvae = GMVAE(4, 2, 3, hidden=(8,))
    action = uniform(200)
    posterior = gmvae.encode(action)
    best = posterior.logits.argmax(-1)
    assert best.unique().numel() > 1
    expected = torch.stack([posterior.loc[i, c] for i, c in enumerate(best)])
    assert torch.equal(gmvae.infer(action), expected)


def gradient_of_log_scale(gmvae: GMVAE, action: Tensor) -> Tensor:
    gmvae.zero_grad()
    GMVAELoss(gmvae)(TensorDict({"action": action}, [len(action)]))["loss_gmvae"].backward()
    return gmvae.likelihood_log_scale.grad


def test_likelihood_scale_has_a_floor_and_can_grow_again() -> None:
    gmvae = GMVAE(4, 2, hidden=(8,))
    nn.init.constant_(gmvae.likelihood_log_scale, -4.5)
    torch.testing.assert_close(gmvae.likelihood_scale, torch.full((4,), -4.0).exp())
    # Large errors: gradient descent raises the scale, although it is below the floor.
    assert (gradient_of_log_scale(gmvae, uniform(64)) < 0).all()
    # No error: descent would lower the scale without limit, so the gradient is 0 at the floor.
    for parameter in gmvae.decoder.parameters():
        nn.init.zeros_(parameter)
    assert (gradient_of_log_scale(gmvae, torch.zeros(64, 4)) == 0).all()
    nn.init.constant_(gmvae.likelihood_log_scale, -3.9)
    assert (gradient_of_log_scale(gmvae, torch.zeros(64, 4)) > 0).all()


def largest_angle(one: Tensor, two: Tensor) -> float:
    """Largest principal angle between two column spaces, in degrees."""
    one, two = torch.linalg.qr(one).Q, torch.linalg.qr(two).Q
    return torch.linalg.svdvals(one.T @ two).amin().clamp(max=1.0).arccos().rad2deg().item()


@pytest.mark.slow
@pytest.mark.parametrize("components", [1, 2])
def test_a_fit_recovers_the_synergies_of_the_analytic_body(components: int) -> None:
    basis = torch.tensor(AnalyticOveractuated(16, 2).synergy_basis, dtype=torch.float32)
    actions = torch.tanh(torch.randn(4096, 2)) @ basis  # within [-1, 1] because rows are unit
    gmvae = GMVAE(16, 2, components, hidden=(64, 64))
    before = SynergyDecoder.from_gmvae(gmvae, actions)
    after = SynergyDecoder.from_gmvae(fit_gmvae(gmvae, actions, updates=700), actions)

    synergy = uniform(2000, dim=2)
    angles = {}
    for name, decoder in (("before", before), ("after", after)):
        with torch.no_grad():
            centered = (out := decoder(synergy)) - out.mean(0)
        spanned = torch.linalg.svd(centered, full_matrices=False).Vh[:2].T
        jacobian = torch.func.jacrev(decoder)(torch.zeros(2)).detach()
        angles[name] = largest_angle(spanned, basis.T), largest_angle(jacobian, basis.T)
    assert max(angles["after"]) < 6.0 < 30.0 < min(angles["before"]), angles
    outside = centered - centered @ basis.T @ basis
    assert outside.square().sum() < 0.005 * centered.square().sum()


# State encoder and latent dynamics


def test_state_encoder_is_invariant_to_the_scale_of_the_observation() -> None:
    encoder = StateEncoder(5, 3, hidden=(64, 16), out_keys=["latent"])
    data = TensorDict({"observation": torch.randn(2, 4, 5)}, [2, 4])
    latent = encoder(data)["latent"]
    assert latent.shape == (2, 4, 3) and encoder.embedding_dim == 3
    # The first layer is normalized: without its bias, scaling the input changes nothing.
    first = encoder.module[0]
    nn.init.zeros_(first.bias)
    torch.testing.assert_close(
        encoder.module(data["observation"]),
        encoder.module(1000 * data["observation"]),
        atol=1e-3,
        rtol=1e-3,
    )
    assert encoder.module(torch.randn(5)).shape == (3,)


def test_a_string_is_one_key() -> None:
    encoder = StateEncoder(5, 3, in_keys="seen", out_keys="embedding")
    dynamics = GaussianDynamics(3, in_keys="embedding", out_keys=("loc", "scale"))
    data = dynamics(encoder(TensorDict({"seen": torch.randn(2, 5)}, [2])))
    assert data["loc"].shape == data["scale"].shape == (2, 3)


def test_state_encoder_refuses_impossible_sizes() -> None:
    with pytest.raises(ValueError, match="embedding_dim is 0"):
        StateEncoder(5, 0)
    with pytest.raises(ValueError, match=r"hidden is \(\)"):
        StateEncoder(5, 3, hidden=())


def test_dynamics_predict_a_change_of_the_embedding() -> None:
    dynamics = GaussianDynamics(3, hidden=(8,))
    for parameter in dynamics.parameters():
        nn.init.zeros_(parameter)
    embedding = torch.randn(6, 3)
    loc, scale = dynamics(embedding)
    assert torch.equal(loc, embedding)
    torch.testing.assert_close(scale, torch.full((6, 3), 2.0).log() + 1e-4)
    bias_of_last_layer(dynamics).copy_(torch.tensor([1.0, 2.0, 3.0, -99.0, -99.0, -99.0]))
    loc, scale = dynamics(embedding)
    torch.testing.assert_close(loc, embedding + torch.tensor([1.0, 2.0, 3.0]))
    assert (scale > 0).all()


# Actor and critic


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 1.0), (-2.0, 6.0)])
def test_log_prob_is_the_density_of_the_samples_in_action_units(low: float, high: float) -> None:
    actor = make_actor({"observation": 3}, Bounded(low, high, shape=(1,)), hidden=(8,))
    distribution = actor.get_dist(TensorDict({"observation": torch.randn(3)}, []))
    grid = torch.linspace(low, high, 40_001)[1:-1]
    density = distribution.log_prob(grid.unsqueeze(-1)).exp()
    assert torch.trapezoid(density, grid).item() == pytest.approx(1.0, abs=1e-3)
    sample, log_prob = distribution.rsample_and_log_prob((50_000,))
    assert ((sample >= low) & (sample <= high)).all()
    torch.testing.assert_close(log_prob, distribution.log_prob(sample), atol=1e-2, rtol=1e-2)
    # Share of the samples below each quarter of the range against the integral of the density.
    for quarter in (0.25, 0.5, 0.75):
        below = grid <= low + quarter * (high - low)
        share = (sample <= low + quarter * (high - low)).float().mean().item()
        assert share == pytest.approx(torch.trapezoid(density[below], grid[below]).item(), abs=0.01)


def test_actor_covers_mixed_bounds_and_concatenates_its_inputs() -> None:
    spec = Bounded(torch.tensor(LOW), torch.tensor(HIGH), shape=(4,))
    actor = make_actor(
        {"observation": 3, ("task", "direction"): 2}, spec, out_key=("arm", "action"), hidden=(8,)
    )
    assert actor.in_keys == ["observation", ("task", "direction")]
    data = {"observation": torch.randn(5000, 3), "task": {"direction": torch.randn(5000, 2)}}
    action = actor(TensorDict(data, [5000]))["arm", "action"]
    assert spec.expand(5000, 4).is_in(action)
    unit = ActionDecoder(1, 4, low=LOW, high=HIGH).normalize(action)
    assert (unit.amin(0) < -0.9).all() and (unit.amax(0) > 0.9).all()


@pytest.mark.parametrize(
    "make",
    [make_actor, make_lattice_actor, partial(make_dynsyn_actor, groups=torch.tensor([0, 1, 0, 1]))],
    ids=["plain", "lattice", "dynsyn"],
)
def test_every_make_actor_takes_several_and_nested_keys(
    make: Any,
) -> None:
    spec = Bounded(torch.tensor(LOW), torch.tensor(HIGH), shape=(4,))
    inputs = {("agent", "observation"): 4, "direction": 2}
    options = {"out_key": ("agent", "action"), "body": "mlp", "hidden": (8,), "layer_norm": False}
    actor = make(inputs, spec, **options)
    assert actor.in_keys == list(inputs) and actor.dist_sample_keys == [("agent", "action")]
    data = {"agent": {"observation": torch.randn(5, 4)}, "direction": torch.randn(5, 2)}
    action = actor(TensorDict(data, [5]))["agent", "action"]
    assert spec.expand(5, 4).is_in(action)


def test_last_entries_have_a_fixed_standard_deviation() -> None:
    spec = Bounded(-1, 1, shape=(5,))
    actor = make_actor({"observation": 3}, spec, hidden=(8,), fixed_std_dims=3, fixed_std=0.02)
    distribution = actor.get_dist(TensorDict({"observation": torch.randn(7, 3)}, [7]))
    assert (distribution.scale[:, 2:] == 0.02).all() and (distribution.scale[:, :2] > 0.5).all()
    distribution.scale.sum().backward()
    weight = actor[0].module[-3].weight.grad  # of the head: five means, five standard deviations
    assert (weight[:5] == 0).all() and (weight[7:] == 0).all() and (weight[5:7] != 0).any()


@pytest.mark.parametrize("layer_norm", [True, False])
def test_layer_norm_follows_every_hidden_layer_or_none(layer_norm: bool) -> None:
    network = {"hidden": (16, 12), "layer_norm": layer_norm}
    for module in (
        make_actor({"observation": 3}, Bounded(-1, 1, shape=(2,)), **network),
        make_critic({"observation": 3, "action": 2}, **network),
    ):
        norms = [m.normalized_shape for m in module.modules() if isinstance(m, nn.LayerNorm)]
        assert norms == ([(16,), (12,)] if layer_norm else [])


def test_critic_is_an_mlp_of_its_concatenated_inputs() -> None:
    critic = make_critic({"observation": 3, "direction": 2, "action": 4}, hidden=(8,))
    inputs = [torch.randn(2, 5, size) for size in (3, 2, 4)]
    joined = nn.Sequential(*critic.module)(torch.cat(inputs, -1))
    torch.testing.assert_close(critic.module(*inputs), joined)


def test_residual_body_adds_each_block_to_its_input() -> None:
    network = make_critic({"observation": 3}, body="residual", hidden=(4, 4)).module
    first, one, two, norm, head = network
    observation = torch.randn(6, 3)
    hidden = first(observation)
    for block in (one, two):
        normed = nn.functional.layer_norm(hidden, (4,), block[0].weight, block[0].bias)
        hidden = hidden + block[3](block[1](normed).relu())
        assert block[1].out_features == 16
    torch.testing.assert_close(network(observation), head(norm(hidden)))


def test_bfloat16_body_keeps_outputs_and_gradients_in_float32() -> None:
    exact = make_critic({"observation": 3}, body="residual", hidden=(16, 16)).module
    network = make_critic({"observation": 3}, body="residual_bfloat16", hidden=(16, 16)).module
    network.load_state_dict(exact.state_dict())
    observation = torch.randn(6, 3)
    out = network(observation)
    out.sum().backward()
    assert out.dtype == torch.float32
    assert all(p.grad.dtype == torch.float32 for p in network.parameters())
    error = (out - exact(observation)).abs().max()
    assert 0 < error < 0.02 * exact(observation).std()


def test_unequal_residual_widths_and_unknown_bodies_are_refused() -> None:
    with pytest.raises(ValueError, match=r"hidden is \[4, 8\].*same width"):
        make_critic({"observation": 3}, body="residual", hidden=(4, 8))
    with pytest.raises(ValueError, match=r"body is 'resnet'.*residual"):
        make_critic({"observation": 3}, body="resnet")


@pytest.mark.parametrize("action", ["action", "synergy", ("arm", "action")])
def test_critic_writes_state_action_value_for_any_action_key(action: object) -> None:
    critic = make_critic({"observation": 3, action: 2}, hidden=(8,))
    data = critic(TensorDict({"observation": torch.randn(5, 3), action: torch.randn(5, 2)}, [5]))
    assert data["state_action_value"].shape == (5, 1)
