"""Random numbers that are given beforehand."""

from __future__ import annotations

import torch

from torchrl_etl.draws import given_draws, standard_normal


def test_an_inner_context_leaves_the_numbers_of_the_outer_one():
    first, second, inner = torch.randn(3, 2)
    with given_draws([first, second]):
        assert standard_normal(first) is first
        with given_draws([inner]):
            assert standard_normal(first) is inner
        assert standard_normal(first) is second
