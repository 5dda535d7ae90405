"""scikit-learn's factorizations, without warnings that do not matter here.

Importing scikit-learn takes a second, which workers that only decode should not spend, so functions
import it when called.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_etl.extras import extra

if TYPE_CHECKING:
    from sklearn.decomposition import NMF, PCA

__all__ = ["ignore_convergence_warnings", "make_nmf", "principal_components"]


def principal_components(rows: np.ndarray, count: int, **options: Any) -> PCA:
    """Fit PCA; ignores its division by the total variance, which is zero for constant rows."""
    with extra("synergies"):
        from sklearn.decomposition import PCA
    with np.errstate(invalid="ignore", divide="ignore"):
        return PCA(count, **options).fit(rows)


def make_nmf(count: int, max_iter: int = 500) -> NMF:
    """NMF with ``count`` components and a deterministic initialization.

    Scale the rows to a maximum of 1: scikit-learn converges poorly on much larger values.
    """
    with extra("synergies"):
        from sklearn.decomposition import NMF
    return NMF(count, init="nndsvda", max_iter=max_iter, random_state=0)


@contextmanager
def ignore_convergence_warnings() -> Iterator[None]:
    """Silence convergence warnings: more iterations would not change a synergy noticeably."""
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        yield
