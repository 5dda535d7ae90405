"""Lasting noise: standard normal at every step, with the autocorrelation of its equation."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import kstest

from torchrl_etl.modules.lasting_noise import HeldNormal, PinkNormal

ROWS = 4000


def drawn(noise: HeldNormal | PinkNormal, steps: int, rows: int = ROWS) -> torch.Tensor:
    """Noise [steps, rows] of one actuator from the first step of an episode on."""
    like, begins = torch.zeros(rows, 1), torch.zeros(rows, dtype=torch.bool)
    return torch.stack([noise(like, begins | (step == 0))[:, 0] for step in range(steps)])


@pytest.mark.parametrize("noise", [HeldNormal(16), PinkNormal(64)], ids=["held", "pink"])
def test_steps_are_standard_normal_from_the_first_on(noise):
    rows = drawn(noise, 20)
    for step in (0, 1, 19):
        assert kstest(rows[step], "norm").pvalue > 0.01


def test_pink_autocorrelation_is_a_mean_of_exponentials():
    """With a_i = exp(-1), exp(-1/2), exp(-1/4): over one step (0.368 + 0.607 + 0.779) / 3."""
    rows = drawn(PinkNormal(longest=7), 12)  # 4 is the largest power of 2 up to 7
    for steps, expected in ((1, 0.5844), (2, 0.3699), (8, 0.0513)):
        found = (rows[0] * rows[steps]).mean().item()
        assert found == pytest.approx(expected, abs=3 / math.sqrt(ROWS))


def test_power_of_pink_noise_falls_as_one_over_frequency():
    """A straight line of slope -1 from the longest time constant up to the fastest change."""
    rows = drawn(PinkNormal(longest=64), 512, rows=400)
    power = torch.fft.rfft(rows, dim=0).abs().square().mean(1)
    frequency = torch.arange(len(power)) / 512
    band = (frequency > 1 / (2 * math.pi * 64)) & (frequency < 0.4)
    scaled = (power * frequency)[band]
    assert scaled.max() / scaled.min() < 2.2
    log = torch.stack([frequency[band].log(), torch.ones(int(band.sum()))], -1)
    slope = torch.linalg.lstsq(log, power[band].log()[:, None]).solution[0].item()
    assert slope == pytest.approx(-1.0, abs=0.2)


@pytest.mark.parametrize("noise", [HeldNormal(1000, 0.01), PinkNormal(1024)], ids=["held", "pink"])
def test_noise_is_independent_across_episodes(noise):
    rows, like = ROWS, torch.zeros(ROWS, 1)
    begins = torch.arange(rows) < rows // 2
    first = noise(like, torch.ones(rows, dtype=torch.bool)).clone().squeeze(-1)
    second = noise(like, begins).squeeze(-1)
    begun, going_on = ((first * second)[part].mean().item() for part in (begins, ~begins))
    assert begun == pytest.approx(0.0, abs=0.07) and going_on > 0.8


@pytest.mark.parametrize("noise", [HeldNormal(16), PinkNormal(64)], ids=["held", "pink"])
def test_noise_starts_anew_in_another_precision_or_on_another_device(noise):
    going_on = torch.zeros(3, dtype=torch.bool)
    for dtype in (torch.float64, torch.float32):
        assert noise(torch.zeros(3, 2, dtype=dtype), going_on).dtype == dtype
    noise(torch.zeros(3, 2, device="meta"), going_on.to("meta"))
    many = torch.zeros(ROWS, 1)
    assert kstest(noise(many, torch.zeros(ROWS, dtype=torch.bool))[:, 0], "norm").pvalue > 0.01


def test_settings_that_cannot_be_used_are_refused():
    for make, words in (
        (lambda: PinkNormal(0), "longest is 0"),
        (lambda: HeldNormal(0), "longest is 0"),
        (lambda: HeldNormal(2, 0.0), "exponent is 0"),
    ):
        with pytest.raises(ValueError, match=words):
            make()
