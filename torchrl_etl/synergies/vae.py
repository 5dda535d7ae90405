"""Synergies of an ordinary VAE: the paper's ablation "ETL w/o GM"."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchrl_etl.synergies.gmvae import GMVAESynergies

__all__ = ["VAESynergies"]


class VAESynergies(GMVAESynergies):
    """A GMVAE with one component, so its prior is a single Gaussian.

    Args:
        low, high (Tensor): bounds of the action [n].
        num_synergies (int): d.
        **options: see :class:`~torchrl_etl.synergies.GMVAESynergies`, except ``num_components``.
    """

    kind = "vae"

    def __init__(self, low: Tensor, high: Tensor, num_synergies: int, **options: Any) -> None:
        super().__init__(low, high, num_synergies, num_components=1, **options)
