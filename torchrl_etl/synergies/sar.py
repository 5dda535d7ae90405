"""Synergies as SAR finds them: principal components turned into independent ones (Berg 2023)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_etl.checks import check_integer
from torchrl_etl.synergies.affine import AffineSynergies
from torchrl_etl.synergies.factors import principal_components, unfinished

__all__ = ["SARSynergies", "independent_components"]


class SARSynergies(AffineSynergies):
    """The mean action and d directions whose coefficients are as independent as can be.

    The model is a = mean + c·basis. SAR's own method, with its play phase and its blend, is
    :class:`~torchrl_etl.methods.SAR`.

    Deviates: SAR's map ends at the bounds in a clamp, beyond which nothing has a gradient, spans
    all coefficients that were seen, and blends in a raw action. Here it is the decoder of every
    affine kind: it bends where a muscle nears its bounds, spans the 1st to the 99th percentile,
    and adds a residual before the bounds, whose entropy is corrected.

    Keyword Args:
        max_iter (int): iterations of the search for independent components at most.
        seed (int): of that search.

    Examples:
        >>> _ = torch.manual_seed(0)
        >>> basis = torch.tensor([[0.3, 0.1, 0.0, 0.2], [0.0, 0.2, -0.3, 0.1]])
        >>> actions = (2 * torch.rand(2000, 2) - 1) @ basis
        >>> model = SARSynergies(-torch.ones(4), torch.ones(4), 2)
        >>> model.fit(actions)
        >>> torch.allclose(model.reconstruct(actions), actions, atol=1e-4)
        True
    """

    kind = "sar"

    def __init__(
        self, low: Tensor, high: Tensor, num_synergies: int, *, max_iter: int = 1000, seed: int = 0
    ) -> None:
        check_integer(1, max_iter=max_iter)
        check_integer(0, seed=seed)
        super().__init__(low, high, num_synergies)
        self.max_iter, self.seed = max_iter, seed

    def factorize(self, actions: np.ndarray) -> np.ndarray:
        mean, basis = independent_components(
            actions, self.num_synergies, seed=self.seed, max_iter=self.max_iter
        )
        self.mean = torch.as_tensor(mean).to(self.low)
        self._inverse = torch.as_tensor(np.linalg.pinv(basis)).to(self.low)
        return basis

    def coefficients(self, actions: Tensor) -> Tensor:
        return (actions - self.mean) @ self._inverse

    def compose(self, coefficients: Tensor) -> Tensor:
        return self.mean + coefficients @ self.basis


def independent_components(
    actions: np.ndarray, count: int, *, seed: int = 0, max_iter: int = 1000
) -> tuple[np.ndarray, np.ndarray]:
    """The mean [n] of actions [N, n], and the basis [count, n] of coefficients of unit variance.

    Principal components first, among which independent ones are then searched for; those along
    which the actions do not vary stay as they are. The actions are in double precision.
    """
    pca = principal_components(actions, count, random_state=seed)
    basis, mean = pca.components_.copy(), pca.mean_
    found = pca.explained_variance_
    varying = int((found > 1e-10 * max(found.max(), 1e-10)).sum())
    if varying > 1:
        from sklearn.decomposition import FastICA

        ica = FastICA(whiten="unit-variance", max_iter=max_iter, random_state=seed)
        with unfinished():  # among components alike in shape, as Gaussian ones, any turn is as good
            ica.fit(pca.transform(actions)[:, :varying])
        mean = mean + ica.mean_ @ basis[:varying]
        basis[:varying] = ica.mixing_.T @ basis[:varying]
    return mean, basis
