"""Diagnostics of a synergy space against numbers worked out by hand."""

import pytest
import torch
from torch import nn

from torchrl_etl.analysis.diagnostics import (
    control_authority,
    direction_alignment,
    synergy_effects,
    synergy_warnings,
)
from torchrl_etl.modules import SynergyDecoder


class LinearDecoder(nn.Module):
    """u -> u @ weight, with the attributes of a SynergyDecoder that diagnostics read."""

    def __init__(self, weight, low, high):
        super().__init__()
        self.weight = torch.tensor(weight)
        self.low, self.high = torch.tensor(low), torch.tensor(high)
        self.num_synergies = self.synergy_dim = len(weight)

    def forward(self, synergy):
        return synergy @ self.weight


def test_authority_of_a_linear_decoder_by_hand():
    # The middle 90 % of U[-1, 1] spans 1.8. Actuator 0 covers its whole range, actuator 1 half of
    # its range, and actuator 2 does not move.
    decoder = LinearDecoder([[1.0, 2.0, 0.0]], [-1.0, -4.0, 0.0], [1.0, 4.0, 1.0])
    expected = torch.tensor([0.9, 0.45, 0.0])
    torch.testing.assert_close(control_authority(decoder), expected, atol=0.02, rtol=0)


def test_authority_is_deterministic_and_leaves_the_global_rng_alone():
    decoder = SynergyDecoder(2, 5)
    state = torch.get_rng_state()
    first = control_authority(decoder)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(control_authority(decoder), first)


def test_synergy_effects_are_signed_and_relative_to_the_action_range():
    decoder = LinearDecoder([[1.0, -2.0], [0.0, 1.0]], [-1.0, 0.0], [1.0, 4.0])
    expected = torch.tensor([[1.0, -1.0], [0.0, 0.5]])
    torch.testing.assert_close(synergy_effects(decoder), expected)


def test_residual_is_left_out_of_authority_and_effects():
    plain, residual = SynergyDecoder(2, 5), SynergyDecoder(2, 5, residual=0.5)
    residual.load_state_dict(plain.state_dict())
    torch.testing.assert_close(control_authority(residual), control_authority(plain))
    torch.testing.assert_close(synergy_effects(residual), synergy_effects(plain))


def test_alignment_by_hand():
    along = torch.tensor([[3.0, 0.0], [-1.0, 0.0], [1.0, 2.0], [1.0, -2.0]])  # around (1, 0)
    ways = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert direction_alignment(along, ways) == pytest.approx((1 + 1 + 0 - 1) / 4)
    assert direction_alignment(7 - along, ways) == pytest.approx(-1 / 4)
    assert direction_alignment(torch.ones(3, 2), ways[:3]) == 0.0  # nothing moved
    with pytest.raises(ValueError, match=r"\[4, 2\] and direction \[3, 2\]"):
        direction_alignment(along, ways[:3])


def test_each_fault_gives_one_warning_with_its_numbers():
    good = {"vaf": 0.8, "pca_vaf": 0.75, "authority": torch.tensor([0.4, 0.6])}
    assert synergy_warnings(**good) == []
    faults = {
        "explain little of the actions' variance: 18% by the GMVAE": {
            "vaf": 0.18,
            "pca_vaf": 0.18,
        },
        "60.0% of the actions' variance, less than PCA "
        "with the same number of dimensions (75.0%)": {"vaf": 0.6},
        "over 5% of its range": {"authority": torch.tensor([0.0, 0.1])},
    }
    for words, fault in faults.items():
        (sentence,) = synergy_warnings(**good | fault)
        assert words in sentence
