"""Variance accounted for, against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch

from torchrl_etl.analysis import variance
from torchrl_etl.analysis.variance import nmf_vaf, pca_vaf, variance_accounted_for


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
def test_vaf_of_constant_actions_is_one_if_exact_and_zero_otherwise(value):
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


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_nmf_is_the_same_in_every_unit(unit):
    actions = low_rank_actions(noise=0.05).clip(0.0)
    assert nmf_vaf(unit * actions, 2, 0.0) == pytest.approx(nmf_vaf(actions, 2, 0.0), abs=1e-6)


def test_nmf_refuses_actions_below_the_bound():
    with pytest.raises(ValueError, match="below the lower bound"):
        nmf_vaf(low_rank_actions() - 0.5, 2, low=0.0)


def test_large_data_are_subsampled_deterministically(monkeypatch):
    actions = low_rank_actions(count=6000, noise=0.1).clip(0.0)
    whole = pca_vaf(actions, 2)
    monkeypatch.setattr(variance, "_PCA_ROWS", 500)
    monkeypatch.setattr(variance, "_NMF_ROWS", 500)
    assert nmf_vaf(actions, 2, 0.0) == nmf_vaf(actions, 2, 0.0)
    assert pca_vaf(actions, 2) != whole
    assert pca_vaf(actions, 2) == pytest.approx(whole, abs=0.05)


@pytest.mark.parametrize("vaf", [pca_vaf, nmf_vaf])
def test_more_synergies_than_actuators_are_refused(vaf):
    with pytest.raises(ValueError, match=r"num_synergies is 13; .* 1\.\.12"):
        vaf(low_rank_actions(), 13)


@pytest.mark.parametrize(
    ("actions", "words"),
    [(np.zeros(3), "at least one action"), ([[math.nan, 1.0]], "not finite")],
)
def test_unusable_actions_are_refused(actions, words):
    with pytest.raises(ValueError, match=words):
        pca_vaf(actions, 1)
