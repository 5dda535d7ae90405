"""Diagnostics of a synergy space against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from torchrl_etl.analysis.diagnostics import (
    MixtureUsage,
    control_authority,
    direction_alignment,
    mixture_usage,
    nmf_vaf,
    pca_vaf,
    synergy_effects,
    synergy_warnings,
    variance_accounted_for,
)
from torchrl_etl.modules import GMVAE, SynergyDecoder


class LinearDecoder(nn.Module):
    """u -> u @ weight, with the attributes of a SynergyDecoder that diagnostics read."""

    def __init__(self, weight, low, high):
        super().__init__()
        self.weight = torch.tensor(weight)
        self.low, self.high = torch.tensor(low), torch.tensor(high)
        self.num_synergies = self.synergy_dim = len(weight)

    def forward(self, synergy):
        return synergy @ self.weight


def low_rank_actions(count=400, n=12, d=3, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    return rng.random((count, d)) @ rng.random((d, n)) + noise * rng.normal(size=(count, n))


def test_vaf_by_hand():
    actions = torch.tensor([[0.0, 1.0], [2.0, 1.0], [4.0, 1.0]])  # mean (2, 1), variance sum 8
    reconstruction = torch.tensor([[1.0, 1.0], [2.0, 0.0], [4.0, 1.0]])  # missed sum 1 + 1
    assert variance_accounted_for(actions, reconstruction) == pytest.approx(0.75)
    assert variance_accounted_for(actions, actions) == 1.0
    mean = actions.mean(0).expand_as(actions)
    assert variance_accounted_for(actions, mean) == pytest.approx(0.0)
    assert variance_accounted_for(actions, -actions) < 0


@pytest.mark.parametrize("value", [0.0, 0.1, -3.0])
def test_vaf_of_constant_actions_is_one_when_they_are_met_and_zero_when_not(value):
    actions = torch.full((50, 3), value)
    assert variance_accounted_for(actions, actions.clone()) == 1.0
    assert variance_accounted_for(actions, actions + 0.01) == 0.0
    assert pca_vaf(actions, 2) == 1.0


def test_pca_vaf_is_the_ratio_of_squared_singular_values():
    actions = low_rank_actions(noise=0.05)
    squares = np.linalg.svd(actions - actions.mean(0), compute_uv=False) ** 2
    for d in (1, 3, 12):
        assert pca_vaf(actions, d) == pytest.approx(squares[:d].sum() / squares.sum(), abs=1e-9)


def test_nmf_recovers_non_negative_parts_above_any_lower_bound():
    low = np.linspace(-2.0, 0.0, 12)
    assert nmf_vaf(low_rank_actions() + low, 3, low) > 0.99
    assert nmf_vaf(low_rank_actions() + low, 1, low) < 0.95


def test_nmf_refuses_actions_below_the_bound():
    with pytest.raises(ValueError, match="below the lower bound"):
        nmf_vaf(low_rank_actions() - 0.5, 2, low=0.0)


def test_large_data_are_subsampled_alike_every_time():
    actions = low_rank_actions(count=6000, noise=0.1).clip(0.0)
    assert nmf_vaf(actions, 2, 0.0, max_samples=500) == nmf_vaf(actions, 2, 0.0, max_samples=500)
    assert pca_vaf(actions, 2, max_samples=500) == pytest.approx(pca_vaf(actions, 2), abs=0.05)


@pytest.mark.parametrize("vaf", [pca_vaf, nmf_vaf])
def test_more_synergies_than_actuators_are_refused(vaf):
    with pytest.raises(ValueError, match=r"num_synergies is 13; .* 1\.\.12"):
        vaf(low_rank_actions(), 13)


def test_authority_of_a_linear_decoder_is_known():
    # The middle 90 % of U[-1, 1] spans 1.8; actuator 0 covers its range, actuator 1 half of its
    # own, actuator 2 does not move.
    decoder = LinearDecoder([[1.0, 2.0, 0.0]], [-1.0, -4.0, 0.0], [1.0, 4.0, 1.0])
    authority = control_authority(decoder, 20_000)
    torch.testing.assert_close(authority, torch.tensor([0.9, 0.45, 0.0]), atol=0.01, rtol=0)


def test_authority_leaves_the_global_seed_alone_and_repeats():
    decoder = SynergyDecoder(2, 5)
    state = torch.get_rng_state()
    first = control_authority(decoder)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(control_authority(decoder), first)
    other = control_authority(decoder, generator=torch.Generator().manual_seed(1))
    assert not torch.equal(other, first)


def test_effects_have_sign_and_are_relative_to_the_range():
    decoder = LinearDecoder([[1.0, -2.0], [0.0, 1.0]], [-1.0, 0.0], [1.0, 4.0])
    expected = torch.tensor([[1.0, -1.0], [0.0, 0.5]])
    torch.testing.assert_close(synergy_effects(decoder), expected)


def test_a_residual_is_not_counted_as_synergy():
    plain, residual = SynergyDecoder(2, 5), SynergyDecoder(2, 5, residual=0.5)
    residual.load_state_dict(plain.state_dict())
    torch.testing.assert_close(control_authority(residual), control_authority(plain))
    torch.testing.assert_close(synergy_effects(residual), synergy_effects(plain))


def test_mixture_usage_tells_an_even_mixture_from_a_collapsed_one():
    gmvae = GMVAE(6, 2, num_components=4)
    final = gmvae.encoder[-1]
    with torch.no_grad():
        final.weight[:4] = 0.0
        final.bias[:4] = 0.0
        even = mixture_usage(gmvae, torch.rand(10, 6))
        final.bias[2] = 50.0
        collapsed = mixture_usage(gmvae, torch.rand(9000, 6))  # more than one piece
    torch.testing.assert_close(even.shares, torch.full((4,), 0.25))
    assert even.effective == pytest.approx(4.0, abs=1e-4)
    torch.testing.assert_close(collapsed.shares, torch.tensor([0.0, 0.0, 1.0, 0.0]))
    assert collapsed.effective == pytest.approx(1.0, abs=1e-4)


def test_alignment_by_hand():
    along = torch.tensor([[3.0, 0.0], [-1.0, 0.0], [1.0, 2.0], [1.0, -2.0]])  # around (1, 0)
    ways = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert direction_alignment(along, ways) == pytest.approx((1 + 1 + 0 - 1) / 4)
    assert direction_alignment(7 - along, ways) == pytest.approx(-1 / 4)
    assert direction_alignment(torch.ones(3, 2), ways[:3]) == 0.0  # nothing moved
    with pytest.raises(ValueError, match=r"\[4, 2\] and direction \[3, 2\]"):
        direction_alignment(along, ways[:3])


def test_each_fault_gets_its_own_sentence_with_its_numbers():
    good = {"vaf": 0.8, "pca_vaf": 0.75, "authority": torch.tensor([0.4, 0.6])}
    even = MixtureUsage(torch.full((4,), 0.25), 4.0)
    assert synergy_warnings(**good, usage=even) == []
    faults = {
        "hardly have synergies: the GMVAE accounts for 18%": {
            "vaf": 0.18,
            "pca_vaf": 0.18,
        },
        "60.0% of the actions' variance, less than PCA's 75.0%": {"vaf": 0.6},
        "over 5% of its range": {"authority": torch.tensor([0.0, 0.1])},
        "collapsed: 1.0 of its 4": {"usage": MixtureUsage(torch.eye(4)[0], 1.0)},
    }
    for words, fault in faults.items():
        (sentence,) = synergy_warnings(**good | {"usage": even} | fault)
        assert words in sentence
    one = MixtureUsage(torch.ones(1), 1.0)
    assert synergy_warnings(**good, usage=one) == []  # a plain VAE cannot collapse


@pytest.mark.parametrize(
    ("actions", "words"),
    [(np.zeros(3), "at least one action"), ([[math.nan, 1.0]], "not finite")],
)
def test_unusable_actions_are_refused(actions, words):
    with pytest.raises(ValueError, match=words):
        pca_vaf(actions, 1)
