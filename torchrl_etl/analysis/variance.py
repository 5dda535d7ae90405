"""Variance of actions accounted for by a synergy model, PCA and NMF."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_etl.analysis.arrays import as_array, as_matrix
from torchrl_etl.synergies.factors import (
    ignore_convergence_warnings,
    make_nmf,
    principal_components,
)

__all__ = ["nmf_vaf", "pca_vaf", "variance_accounted_for"]

_PCA_ROWS, _NMF_ROWS = 50_000, 5_000
"""Maximum numbers of actions to fit; more are subsampled, with a fixed seed."""


def variance_accounted_for(
    actions: Tensor | ArrayLike,
    reconstruction: Tensor | ArrayLike,
    *,
    mean: Tensor | ArrayLike | None = None,
) -> float:
    """Variance accounted for: 1 − Σ‖a − â‖² / Σ‖a − ā‖², with ā the mean action.

    1 is a perfect reconstruction, 0 is as good as the mean action, and negative values are worse.
    For constant actions, which have no variance, the result is 1 if they are reconstructed up to
    rounding error, otherwise 0.

    Args:
        actions (Tensor or array): actions [*, n].
        reconstruction (Tensor or array): their reconstructions, of the same shape.

    Keyword Args:
        mean (Tensor or array, optional): ā [n], for example of a larger set. Default: their mean.

    Raises:
        ValueError: if the shapes differ, there are no actions, or a number is not finite.

    Examples:
        >>> variance_accounted_for([[0.0], [2.0], [4.0]], [[1.0], [2.0], [3.0]])
        0.75
    """
    actions = as_matrix(actions, "actions")
    reconstruction = as_matrix(reconstruction, "reconstruction")
    if actions.shape != reconstruction.shape:
        raise ValueError(
            f"actions flatten to {actions.shape} but reconstruction to {reconstruction.shape}; "
            "pass one reconstructed action per action."
        )
    missed = float(np.square(actions - reconstruction).sum())
    center = actions.mean(0) if mean is None else as_array(mean)
    total = float(np.square(actions - center).sum())
    # Rounding gives constant columns a relative variance of about (1e-16)², and float32 data a
    # relative residual of about (1e-7)².
    size = float(np.square(actions).sum())
    if total <= 1e-24 * size:
        return 1.0 if missed <= 1e-12 * size else 0.0
    return 1.0 - missed / total


def pca_vaf(actions: Tensor | ArrayLike, num_synergies: int) -> float:
    """Variance accounted for by ``num_synergies`` principal components.

    No affine decoder can do better on these actions; a nonlinear one should. Of more than 50,000
    actions, as many are drawn with a fixed seed.

    Args:
        actions (Tensor or array): actions [*, n].
        num_synergies (int): number d of principal components.

    Raises:
        ValueError: if d exceeds the number of actuators or actions, or an action is not finite.

    Examples:
        >>> round(pca_vaf([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0]], num_synergies=1), 6)
        1.0
    """
    actions = _subsample(as_matrix(actions, "actions"), _PCA_ROWS)
    _check_rank(num_synergies, actions)
    model = principal_components(actions, num_synergies, svd_solver="covariance_eigh")
    return variance_accounted_for(actions, model.inverse_transform(model.transform(actions)))


def nmf_vaf(
    actions: Tensor | ArrayLike,
    num_synergies: int,
    low: float | Tensor | ArrayLike = -1.0,
) -> float:
    """Variance accounted for by non-negative matrix factorization with ``num_synergies`` parts.

    NMF is the usual method to extract muscle synergies from recordings. It is fitted to a − low,
    which is never negative. The variance is about the mean action, so that results compare with
    those of other models. NMF has no offset, so with few parts the result can be negative. Of more
    than 5,000 actions, as many are drawn with a fixed seed.

    Args:
        actions (Tensor or array): actions [*, n].
        num_synergies (int): number d of parts.
        low (float, Tensor or array): lower action bound, one or [n]. Default: -1.

    Raises:
        ValueError: if an action is below ``low``, d exceeds the number of actuators or actions, or
            an action is not finite.

    Examples:
        >>> import torch
        >>> parts = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
        >>> weights = torch.rand(64, 2, generator=torch.Generator().manual_seed(0))
        >>> round(nmf_vaf(weights @ parts, num_synergies=2, low=0.0), 2)
        1.0
    """
    actions = _subsample(as_matrix(actions, "actions"), _NMF_ROWS)
    _check_rank(num_synergies, actions)
    shifted = actions - as_array(low)
    if shifted.min() < -1e-4:
        raise ValueError(
            f"An action is {-shifted.min():.3g} below the lower bound; pass the lower bound of the "
            "actions' spec as low."
        )
    shifted = shifted.clip(min=0.0) / (shifted.max() or 1.0)
    model = make_nmf(num_synergies)
    with ignore_convergence_warnings():
        weights = model.fit_transform(shifted)
    return variance_accounted_for(shifted, weights @ model.components_)


def _subsample(actions: np.ndarray, count: int) -> np.ndarray:
    if len(actions) <= count:
        return actions
    return actions[np.random.default_rng(0).choice(len(actions), count, replace=False)]


def _check_rank(num_synergies: int, actions: np.ndarray) -> None:
    if not 1 <= num_synergies <= min(actions.shape):
        raise ValueError(
            f"num_synergies is {num_synergies}; with {len(actions)} actions of "
            f"{actions.shape[1]} actuators it must lie in 1..{min(actions.shape)}."
        )
