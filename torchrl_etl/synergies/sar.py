"""Synergies of SAR: principal, then independent components (Berg 2023)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_etl.checks import check_integer
from torchrl_etl.modules import SARDecoder
from torchrl_etl.modules.recorded_actions import as_actions
from torchrl_etl.synergies.affine import AffineSynergies
from torchrl_etl.synergies.factors import ignore_convergence_warnings, principal_components

__all__ = ["SARSynergies", "independent_components"]

_LEAST_VARIATION = 1e-5  # of the largest; a synergy below it moves nothing


class SARSynergies(AffineSynergies):
    """The mean action and d directions with maximally independent coefficients.

    The model is a = mean + c·basis. The complete method, with play phase and blend, is
    :class:`~torchrl_etl.methods.SAR`.

    Deviates: SAR's map clamps actions to the bounds, where gradients vanish, spans all observed
    coefficients, and blends in a raw action: :meth:`blended_decoder`. Here the decoder is that of
    every affine kind: it saturates smoothly near the bounds, spans the 1st to the 99th percentile
    of coefficients, and adds a residual before the bounds, with an entropy correction.

    Keyword Args:
        max_iter (int): maximum number of ICA iterations.
        seed (int): seed of PCA and ICA.

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
        self._components = torch.as_tensor(mean), torch.as_tensor(basis)  # in double precision
        self.mean = self._components[0].to(self.low)
        self._inverse = torch.as_tensor(np.linalg.pinv(basis)).to(self.low)
        return basis

    def coefficients(self, actions: Tensor) -> Tensor:
        return (actions - self.mean) @ self._inverse

    def compose(self, coefficients: Tensor) -> Tensor:
        return self.mean + coefficients @ self.basis

    def blended_decoder(self, actions: Tensor, **options: Any) -> SARDecoder:
        """SAR's own map, each of its coefficients scaled so that ``actions`` [N, n] span [-1, 1].

        Deviates: the public code is fitted on activations in [0, 1] but outputs actions, which pass
        MyoSuite's sigmoid once more. Here ``actions`` are activations mapped back through the
        sigmoid to action units, a = 1/2 + ln(x / (1 - x)) / 5. The entry ``activation`` of
        ``make_env(..., activations=True)`` already is in these units.

        Keyword Args:
            blend, in_keys, out_keys: see :class:`~torchrl_etl.modules.SARDecoder`.

        Raises:
            ValueError: if the actions vary in fewer than d dimensions.

        Examples:
            >>> actions = (torch.rand(100, 2) @ torch.rand(2, 6)).clamp(-1, 1)
            >>> model = SARSynergies(-torch.ones(6), torch.ones(6), 2)
            >>> model.fit(actions)
            >>> model.blended_decoder(actions, blend=0.66).synergy_spec.shape
            torch.Size([8])
        """
        self._check_fitted()
        actions = as_actions(actions, low=self.low, high=self.high, min_rows=2)
        mean, basis = self._components
        least, most = ((actions.cpu().double() - mean) @ basis.pinverse()).aminmax(dim=0)
        mean, basis = mean + (least + most) / 2 @ basis, ((most - least) / 2)[:, None] * basis
        sizes = basis.norm(dim=-1)
        if (varying := int((sizes > _LEAST_VARIATION * sizes.max()).sum())) < self.num_synergies:
            raise ValueError(
                f"{len(actions)} actions that vary in {varying} dimensions are too few for "
                f"{self.num_synergies} synergies; collect more actions, or use fewer synergies."
            )
        return SARDecoder.from_basis(
            mean.to(self.low), basis.to(self.low), low=self.low, high=self.high, **options
        )


def independent_components(
    actions: np.ndarray, count: int, *, seed: int = 0, max_iter: int = 1000
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [n] of actions [N, n] in double precision, and a basis [count, n] from PCA and ICA.

    ICA turns the principal components that vary, if at least two, into independent components with
    coefficients of unit variance. Other principal components are kept unchanged.
    """
    pca = principal_components(actions, count, random_state=seed)
    basis, mean = pca.components_.copy(), pca.mean_
    found = pca.explained_variance_
    varying = int((found > 1e-10 * max(found.max(), 1e-10)).sum())
    if varying > 1:
        from sklearn.decomposition import FastICA

        ica = FastICA(whiten="unit-variance", max_iter=max_iter, random_state=seed)
        with ignore_convergence_warnings():  # any rotation is as good among Gaussian components
            ica.fit(pca.transform(actions)[:, :varying])
        mean = mean + ica.mean_ @ basis[:varying]
        basis[:varying] = ica.mixing_.T @ basis[:varying]
    return mean, basis
