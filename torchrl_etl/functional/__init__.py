"""Equations 1-10 of Explore to Learn, and other mathematics, as pure functions of tensors.

They have no keys, modules or state, and accept any number of leading batch dimensions (written
``*``). Reduction over the batch is left to the caller, except in
:func:`~torchrl_etl.functional.effective_rank`. Symbols: ``n`` actuators, ``d`` synergies, ``k``
embedding dimensions, ``C`` mixture components.
"""

from torchrl_etl.functional.bounded_least_squares import bounded_least_squares
from torchrl_etl.functional.categorical import (
    categorical_cross_entropy,
    categorical_mean,
    project_categorical,
)
from torchrl_etl.functional.metric import (
    direction_bonus,
    discriminability,
    effective_rank,
    expected_distance,
    gaussian_w2,
    l2_distance,
    metric_loss,
    metric_target,
    mico_distance,
)
from torchrl_etl.functional.synergy import (
    GMVAEBound,
    categorical_kl,
    gaussian_kl,
    gaussian_log_prob,
    gmvae_bound,
    mixture_log_prob,
    reconstruction_loss,
)
from torchrl_etl.functional.tanh_sum import tanh_sum, tanh_sum_log_slope

__all__ = [
    "GMVAEBound",
    "bounded_least_squares",
    "categorical_cross_entropy",
    "categorical_kl",
    "categorical_mean",
    "direction_bonus",
    "discriminability",
    "effective_rank",
    "expected_distance",
    "gaussian_kl",
    "gaussian_log_prob",
    "gaussian_w2",
    "gmvae_bound",
    "l2_distance",
    "metric_loss",
    "metric_target",
    "mico_distance",
    "mixture_log_prob",
    "project_categorical",
    "reconstruction_loss",
    "tanh_sum",
    "tanh_sum_log_slope",
]
