"""How many synergies a recording has: variance accounted for in rows that a model has not seen."""

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
    """Variance accounted for of one number of synergies, see :func:`cross_validate`.

    Attributes:
        fitted (float): by the model of all rows, in these rows.
        held_out (float): in every row by the model that was fitted without it.
        lowest, highest (float): the same in the fold that is told worst and best.
    """

    fitted: float
    held_out: float
    lowest: float
    highest: float


def held_out_rows(rows: int, folds: int = 5, trials: ArrayLike | None = None) -> list[np.ndarray]:
    """Which rows are held out together: whole trials, or blocks of neighbours.

    Neighbouring rows of a recording are nearly alike, so rows drawn at random would be no test.

    Args:
        rows (int): N.
        folds (int): into how many parts; at most as many as there are trials, or rows. Default: 5.
        trials (array, optional): the trial of each row [N].

    Returns:
        list of np.ndarray: indices, each row in one of them.

    Raises:
        ValueError: if there are fewer than two folds, trials or rows.

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
        raise ValueError(f"{len(trials)} trials came for {rows} rows; pass one for each row.")
    names, sizes = np.unique(trials, return_counts=True)
    if len(names) < 2:
        raise ValueError(
            f"All rows are of trial {names[0]}, so none can be held out; pass no trials."
        )
    # The longest first, each into the part that is shortest so far.
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
    """Fit a model to all rows and, for each fold, to all rows but those of the fold.

    Equation: 1 − Σ‖a − â‖² / Σ‖a − ā‖² over all rows, or those of one fold, with â of the model
    that was fitted without the row and ā the mean of all rows. (A fold's own mean would leave a
    fold of one row no variance to account for.)

    Args:
        fit (callable): a model fitted to rows [N, n] in single precision.
        activity (array): [N, n].

    Keyword Args:
        folds, trials: see :func:`held_out_rows`.

    Returns:
        CrossValidation and the model of all rows.

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
    """The fewest synergies that account for ``least`` of held-out rows, or else the best number.

    Examples:
        >>> found = {1: CrossValidation(0.6, 0.5, 0.4, 0.7), 2: CrossValidation(0.9, 0.8, 0.7, 0.9)}
        >>> enough_synergies(found, 0.5), enough_synergies(found, 0.9)
        (1, 2)
    """
    enough = [number for number, of in sorted(found.items()) if of.held_out >= least]
    return enough[0] if enough else max(found, key=lambda number: found[number].held_out)
