"""SynergyDecoder: made of a GMVAE or of directions, its range of coefficients, residuals."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from tests.test_modules import HIGH, LOW, bias_of_last_layer, same, uniform, weights
from torchrl_etl.functional import tanh_sum, tanh_sum_log_slope
from torchrl_etl.modules import GMVAE, SynergyDecoder
from torchrl_etl.synergies import load_bundle, save_bundle


def fitted(residual: float = 0.0, **kwargs: object) -> tuple[GMVAE, SynergyDecoder, Tensor]:
    gmvae = GMVAE(4, 2, 3, low=LOW, high=HIGH, hidden=(8, 16))
    actions = uniform(4000, LOW, HIGH)
    return gmvae, SynergyDecoder.from_gmvae(gmvae, actions, residual=residual, **kwargs), actions


def test_training_a_decoder_leaves_its_gmvae_unchanged() -> None:
    gmvae, decoder, actions = fitted()
    before = weights(gmvae)
    optimizer = torch.optim.Adam(decoder.parameters(), 0.1)
    (decoder(uniform(4000, dim=2)) - actions).square().mean().backward()
    optimizer.step()
    assert same(weights(gmvae), before)
    assert all(parameter.grad is None for parameter in gmvae.parameters())
    inner = weights(gmvae.decoder)
    assert not same(weights(decoder.module.decoder), inner)


def test_decoder_equals_the_gmvae_at_the_scaled_latent() -> None:
    for dtype in (torch.float32, torch.float64):
        gmvae = GMVAE(4, 2, hidden=(8,)).to(dtype)
        decoder = SynergyDecoder.from_gmvae(gmvae, uniform(100).to(dtype))
        synergy = uniform(7, dim=2).to(dtype)
        latent = decoder.module.center + decoder.module.scale * synergy
        assert torch.equal(decoder(synergy), gmvae.decode(latent))


def test_the_box_covers_98_percent_of_the_latents_in_each_dimension() -> None:
    gmvae, decoder, actions = fitted()
    synergy = (gmvae.infer(actions) - decoder.module.center) / decoder.module.scale
    for share, lower, upper in ((0.98, -1, 1), (0.01, -9e9, -1), (0.01, 1, 9e9)):
        inside = ((synergy >= lower) & (synergy <= upper)).float().mean(0)
        torch.testing.assert_close(inside, torch.full((2,), share), atol=1e-3, rtol=0)


def test_without_actions_the_box_spans_the_prior() -> None:
    gmvae = GMVAE(4, 2, 2, hidden=(8,))
    gmvae.prior_loc.data = torch.tensor([[-1.0, 0.0], [3.0, 0.0]])
    gmvae.prior_log_scale.data = torch.tensor([[1.0, 1.0], [0.5, 2.0]]).log()
    scaled = SynergyDecoder.from_gmvae(gmvae).module
    # min(-1 - 2, 3 - 1) to max(-1 + 2, 3 + 1), and ±2·2.
    torch.testing.assert_close(scaled.center, torch.tensor([0.5, 0.0]))
    torch.testing.assert_close(scaled.scale, torch.tensor([3.5, 4.0]))


def test_residual_by_hand() -> None:
    decoder = SynergyDecoder(1, 2, low=[0.0, -1.0], high=[1.0, 3.0], hidden=(4,), residual=0.5)
    for parameter in decoder.parameters():
        nn.init.zeros_(parameter)  # synergies decode to the middle of both ranges, (0.5, 1)
    middle = torch.tensor([[0.3, 0.0, 0.0], [0.3, 1.0, -0.5], [0.3, -0.2, 1.0]])
    expected = torch.tensor([[0.5, 1.0], [0.75, 0.5], [0.45, 2.0]])
    torch.testing.assert_close(decoder(middle), expected)
    torch.testing.assert_close(decoder.log_slope(middle), torch.zeros(3))
    # Synergies decode to 0.6 and -0.6 in units of the half ranges, and the residual of ±0.5 is
    # added: (0.6 + 0.5) / 1.3 = 11/13 and (-0.6 + 0.5) / 0.7 = -1/7.
    bias_of_last_layer(decoder).copy_(torch.tensor([0.6, -0.6]).atanh())
    synergy = torch.tensor([[0.3, 1.0, 1.0], [0.3, -1.0, 0.0]])
    unit = torch.tensor([[11 / 13, -1 / 7], [1 / 7, -0.6]])
    torch.testing.assert_close(
        decoder(synergy),
        torch.tensor([0.5, 1.0]) + torch.tensor([0.5, 2.0]) * unit,
        atol=5e-4,
        rtol=0,
    )
    slopes = torch.tensor([[0.64 / 1.3**2, 0.64 / 0.7**2], [0.64 / 0.7**2, 0.64]])
    torch.testing.assert_close(decoder.log_slope(synergy), slopes.log().sum(-1), atol=1e-3, rtol=0)
    assert decoder.log_slope(synergy[0]).shape == ()


def test_full_residual_reaches_every_action() -> None:
    decoder = fitted(residual=1.0)[1].double()
    wanted = uniform(500, LOW, HIGH).double()
    coefficients = torch.cat([uniform(500, dim=2), torch.zeros(500, 4)], -1).double()
    base, _ = decoder.module.summands(coefficients)
    unit = decoder.module.decoder.normalize(wanted)
    coefficients[:, 2:] = (unit - base) / (1 - unit * base)
    assert coefficients.abs().max() <= 1
    torch.testing.assert_close(decoder(coefficients), wanted)


def test_residual_keeps_its_gradient_near_saturation() -> None:
    decoder = SynergyDecoder(1, 2, hidden=(4,), residual=1.0)
    bias_of_last_layer(decoder).copy_(torch.tensor([20.0, -20.0]))  # a tanh of 1 and -1
    synergy = torch.tensor([[0.0, 0.9, -0.9], [0.0, -0.9999, 0.9999], [0.0, -1.0, 1.0]])
    synergy.requires_grad_()
    decoder(synergy).sum().backward()
    assert (synergy.grad[:2, 1:] != 0).all() and synergy.grad.isfinite().all()
    assert decoder.log_slope(synergy).isfinite().all()


def test_keys_may_be_single_strings() -> None:
    decoder = SynergyDecoder(2, 4, in_keys="syn", out_keys="act")
    assert (decoder.in_keys, decoder.out_keys) == (["syn"], ["act"])


@pytest.mark.parametrize("residual", [-0.1, 1.1])
def test_residual_outside_zero_to_one_is_refused(residual: float) -> None:
    with pytest.raises(ValueError, match=r"must be in \[0, 1\]"):
        SynergyDecoder(2, 4, residual=residual)


@pytest.mark.parametrize("residual", [0.0, 0.3])
def test_log_slope_is_the_log_determinant_of_the_residual(residual: float) -> None:
    decoder = fitted(residual)[1].double()
    synergy = uniform(3, dim=decoder.synergy_dim).double()
    expected = torch.zeros(3, dtype=torch.float64)
    if residual:
        at_rest = (torch.as_tensor(HIGH) - torch.as_tensor(LOW)) / 2 * residual
        for i, row in enumerate(synergy):
            jacobian = torch.func.jacrev(decoder.module)(row)[:, 2:]
            expected[i] = jacobian.det().log() - at_rest.double().log().sum()
    torch.testing.assert_close(decoder.log_slope(synergy), expected)


@pytest.mark.parametrize("residual", [0.0, 0.3])
def test_config_and_state_dict_rebuild_the_decoder(residual: float) -> None:
    decoder = fitted(residual)[1]
    config = json.loads(json.dumps(decoder.config))
    torch.manual_seed(5)
    other = SynergyDecoder(**config)
    other.load_state_dict(decoder.state_dict())
    assert same(weights(other), weights(decoder))
    synergy = uniform(50, dim=decoder.synergy_dim)
    assert torch.equal(other(synergy), decoder(synergy))
    assert other.config == decoder.config


@pytest.mark.parametrize(("residual", "size"), [(0.0, 2), (0.3, 6)])
def test_synergy_spec_bounds_the_input_of_the_decoder(residual: float, size: int) -> None:
    keys = {"in_keys": [("arm", "synergy")], "out_keys": [("arm", "action")]}
    decoder = fitted(residual, **keys)[1]
    spec = decoder.synergy_spec
    assert spec.shape == (size,) == (decoder.synergy_dim,)
    assert (spec.space.low == -1).all() and (spec.space.high == 1).all()
    data = decoder(TensorDict({("arm", "synergy"): spec.rand((9,))}, [9]))
    action = data["arm", "action"]
    assert action.shape == (9, 4)
    assert ((action >= decoder.low) & (action <= decoder.high)).all()


def test_tanh_sum_is_bounded_and_accurate_near_saturation() -> None:
    ends = 1 - torch.logspace(-6, -1, 200)
    for x, y in ((ends, -ends.flip(0)), (-ends, torch.ones(200)), (ends, ends), (ends, -ends)):
        found = tanh_sum(x, y)
        assert (found.abs() <= 1).all()
        torch.testing.assert_close(found, tanh_sum(x.double(), y.double()).float())
        slope = tanh_sum_log_slope(x, y)
        expected = tanh_sum_log_slope(x.double(), y.double()).float()
        torch.testing.assert_close(slope, expected)


def test_from_directions_has_the_given_slope_and_stays_in_bounds() -> None:
    center = torch.tensor([0.25, 0.0, 4.0, 0.3])
    directions = torch.tensor([[1.0, 0.0, -2.0, 0.1], [0.0, 0.5, 0.0, -0.2]])
    decoder = SynergyDecoder.from_directions(center, directions, low=LOW, high=HIGH)
    at = torch.zeros(2)
    torch.testing.assert_close(decoder.module(at), center)
    slope = torch.autograd.functional.jacobian(decoder.module, at)
    torch.testing.assert_close(slope, directions.mT)
    far = decoder.module(torch.tensor([1.0, 1.0]))
    # Muscle 0 in [0, 1]: tanh⁻¹(-0.5) + 2·1 / (1 - 0.5²) by hand.
    torch.testing.assert_close(far[0], torch.tensor((math.tanh(2.117361) + 1) / 2))
    assert ((far > decoder.low) & (far < decoder.high)).all()


def test_encode_is_the_best_within_the_box_for_nearly_parallel_directions() -> None:
    directions = torch.tensor([[0.3, 0.3, 0.0], [0.3, 0.3, 0.01]])
    decoder = SynergyDecoder.from_directions(torch.zeros(3), directions)
    action = decoder(torch.tensor([[-0.6, 1.0]])) + torch.tensor([[0.0, 0.0, 0.02]])
    for dtype in (torch.float32, torch.float16):
        coefficients = decoder.to(dtype).encode(action.detach())
        assert coefficients.dtype == dtype
        torch.testing.assert_close(
            coefficients.float(), torch.tensor([[-0.6, 1.0]]), atol=0.03, rtol=0
        )


def test_coefficients_in_double_precision_are_decoded_in_the_decoders() -> None:
    decoder = SynergyDecoder.from_gmvae(GMVAE(4, 2), residual=1.0)
    synergy = torch.zeros(3, 6)
    assert torch.equal(decoder(synergy.double()), decoder(synergy))


def test_from_directions_survives_a_bundle_round_trip(tmp_path: Path) -> None:
    decoder = SynergyDecoder.from_directions(torch.zeros(4), torch.rand(2, 4), residual=0.5)
    save_bundle(decoder, tmp_path / "synergies", task="toy", actuators=list("abcd"))
    copy, info = load_bundle(tmp_path)
    assert info.num_synergies == 2
    synergy = uniform(20, dim=6)
    assert torch.equal(copy.module(synergy), decoder.module(synergy))


@pytest.mark.parametrize(
    ("center", "directions", "words"),
    [
        (torch.zeros(4), torch.zeros(2, 3), r"center has shape \[4\] and directions \[2, 3\]"),
        (torch.tensor([0.0, 1.0]), torch.zeros(1, 2), "Entry 1 of center is not inside"),
    ],
)
def test_invalid_directions_are_refused(center: Tensor, directions: Tensor, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SynergyDecoder.from_directions(center, directions)
