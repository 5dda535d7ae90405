"""Cross-validated number of synergies: variance accounted for in held-out rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_etl.analysis.arrays import as_matrix
from torchrl_etl.analysis.variance import variance_accounted_for
from torchrl_etl.checks import check_integer
from torchrl_etl.synergies import SynergyModel

__all__ = ["CrossValidation", "cross_validate", "enough_synergies", "held_out_rows"]


class CrossValidation(NamedTuple):
    """Variance accounted for (VAF) by one number of synergies, see :func:`cross_validate`.

    Attributes:
        fitted (float): VAF of the model fitted to all rows, in the same rows.
        held_out (float): VAF over all rows, each reconstructed by a model fitted without it.
        lowest, highest (float): held-out VAF of the worst and the best fold.
    """

    fitted: float
    held_out: float
    lowest: float
    highest: float


def held_out_rows(rows: int, folds: int = 5, trials: ArrayLike | None = None) -> list[np.ndarray]:
    """Folds of rows for cross-validation: whole trials, or blocks of neighbouring rows.

    Neighbouring rows of a recording are nearly alike, so random folds would hold out too little.

    Args:
        rows (int): N.
        folds (int): number of folds, reduced to the number of trials or rows. Default: 5.
        trials (array, optional): the trial of each row [N].

    Returns:
        list of np.ndarray: row indices of each fold; every row is in exactly one.

    Raises:
        ValueError: if there are fewer than two folds, trials or rows, or a row has no trial.

    Examples:
        >>> [part.tolist() for part in held_out_rows(5, folds=2)]
        [[0, 1, 2], [3, 4]]
        >>> [part.tolist() for part in held_out_rows(5, trials=["b", "a", "b", "c", "a"], folds=2)]
        [[1, 3, 4], [0, 2]]
    """
    check_integer(2, folds=folds, rows=rows)
    if trials is None:
        return np.array_split(np.arange(rows), min(folds, rows))
    trials = np.asarray(trials)
    if trials.shape != (rows,):
        raise ValueError(f"There are {len(trials)} trials for {rows} rows; pass one for each row.")
    # NaN differs from itself.
    if missing := [i for i, one in enumerate(trials.tolist()) if one is None or one != one]:
        raise ValueError(f"Row {missing[0]} has no trial; give it one, or leave the row out.")
    names, sizes = np.unique(trials, return_counts=True)
    if len(names) < 2:
        raise ValueError(
            f"All rows belong to trial {names[0]}, so no trial can be held out; leave trials out."
        )
    # Greedy: the longest trial first, each into the currently smallest fold.
    parts: list[list] = [[] for _ in range(min(folds, len(names)))]
    filled = np.zeros(len(parts), dtype=int)
    for i in np.argsort(-sizes, kind="stable"):
        shortest = int(filled.argmin())
        parts[shortest].append(names[i])
        filled[shortest] += sizes[i]
    return [np.flatnonzero(np.isin(trials, part)) for part in parts]


def cross_validate(
    fit: Callable[[Tensor], SynergyModel],
    activity: Tensor | ArrayLike,
    *,
    folds: int = 5,
    trials: ArrayLike | None = None,
) -> tuple[CrossValidation, SynergyModel]:
    """Fit a model to all rows and, for each fold, to all rows outside the fold.

    Equation: 1 − Σ‖a − â‖² / Σ‖a − ā‖² over all rows, or those of one fold, with â from the model
    fitted without the row and ā the mean of all rows. (With its own mean, a fold of one row would
    have no variance.)

    Args:
        fit (callable): fits a model to float32 rows [N, n].
        activity (array): [N, n].

    Keyword Args:
        folds, trials: see :func:`held_out_rows`.

    Returns:
        CrossValidation and the model fitted to all rows.

    Raises:
        ValueError: see :func:`held_out_rows`.

    Examples:
        >>> from torchrl_etl.synergies import fit_synergies
        >>> rng = np.random.default_rng(0)
        >>> emg = rng.random((300, 2)) @ rng.random((2, 6)) / 2  # two sources, six muscles
        >>> fit = lambda rows: fit_synergies(rows, "nmf", 2, low=0.0, high=1.0)
        >>> found, model = cross_validate(fit, emg)
        >>> found.held_out > 0.99, model.num_synergies
        (True, 2)
    """
    rows = torch.as_tensor(as_matrix(activity, "activity"), dtype=torch.float32)
    parts = held_out_rows(len(rows), folds, trials)
    told = torch.empty_like(rows)
    model = fit(rows)
    with torch.no_grad():
        fitted = variance_accounted_for(rows, model.reconstruct(rows))
    for part in parts:
        rest = np.setdiff1d(np.arange(len(rows)), part)
        without = fit(rows[rest])
        with torch.no_grad():
            told[part] = without.reconstruct(rows[part])
    mean = as_matrix(rows, "activity").mean(0)
    of_parts = [variance_accounted_for(rows[part], told[part], mean=mean) for part in parts]
    held_out = variance_accounted_for(rows, told)
    return CrossValidation(fitted, held_out, min(of_parts), max(of_parts)), model


def enough_synergies(found: dict[int, CrossValidation], least: float) -> int:
    """The fewest synergies with a held-out VAF of ``least``, or else the number with the best VAF.

    Examples:
        >>> found = {1: CrossValidation(0.6, 0.5, 0.4, 0.7), 2: CrossValidation(0.9, 0.8, 0.7, 0.9)}
        >>> enough_synergies(found, 0.5), enough_synergies(found, 0.9)
        (1, 2)
    """
    enough = [number for number, of in sorted(found.items()) if of.held_out >= least]
    return enough[0] if enough else max(found, key=lambda number: found[number].held_out)
