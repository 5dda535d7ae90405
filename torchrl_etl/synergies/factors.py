"""scikit-learn's factors, without what it complains of that changes nothing here.

It takes a second to import, which a worker that only decodes should not spend: no file does so at
its top.
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

__all__ = ["make_nmf", "principal_components", "unfinished"]


def principal_components(rows: np.ndarray, count: int, **options: Any) -> PCA:
    """Fit PCA; on its way it divides by the total variance, which constant rows do not have."""
    with extra("synergies"):
        from sklearn.decomposition import PCA
    with np.errstate(invalid="ignore", divide="ignore"):
        return PCA(count, **options).fit(rows)


def make_nmf(count: int, max_iter: int = 500) -> NMF:
    """A factorization into ``count`` parts that begins alike every time."""
    with extra("synergies"):
        from sklearn.decomposition import NMF
    return NMF(count, init="nndsvda", max_iter=max_iter, random_state=0)


@contextmanager
def unfinished() -> Iterator[None]:
    """The last digits that more iterations would bring do not change a synergy."""
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        yield
