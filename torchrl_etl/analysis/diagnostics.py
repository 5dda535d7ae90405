"""Diagnostics of a synergy space, and warnings about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_etl.analysis.arrays import as_array, as_matrix

if TYPE_CHECKING:
    from torchrl_etl.modules import SynergyMap

__all__ = ["control_authority", "direction_alignment", "synergy_effects", "synergy_warnings"]

_SAMPLES = 1024


@torch.no_grad()
def control_authority(decoder: SynergyMap) -> Tensor:
    """Fraction of its range over which the synergies move each actuator [n].

    The distance from the 5th to the 95th percentile of Dec(u), u uniform in [-1, 1]^d, divided by
    high − low. It is 0.9 for a muscle that follows one coefficient linearly over its whole range,
    and 0 for one that never moves. A residual is held at zero. Reports average it over actuators.
    The 1,024 coefficient vectors are drawn with a fixed seed, without the global generator.

    Args:
        decoder (SynergyMap): the decoder.

    Examples:
        >>> from torchrl_etl.modules import GMVAE, SynergyDecoder
        >>> authority = control_authority(SynergyDecoder.from_gmvae(GMVAE(39, 4)))
        >>> authority.shape, bool((authority > 0).all() and (authority < 1).all())
        (torch.Size([39]), True)
    """
    generator = torch.Generator().manual_seed(0)
    synergies = torch.rand(_SAMPLES, decoder.num_synergies, generator=generator)
    action = _decode(decoder, 2 * synergies - 1)
    low, high = action.quantile(torch.tensor([0.05, 0.95], device=action.device), dim=0)
    return (high - low) / (decoder.high - decoder.low)


@torch.no_grad()
def synergy_effects(decoder: SynergyMap) -> Tensor:
    """Signed change of each actuator when one coefficient goes from -1 to +1 [d, n].

    The other coefficients and a residual are 0. A change of 1 is the actuator's whole range.

    Args:
        decoder (SynergyMap): the decoder.

    Examples:
        >>> from torchrl_etl.modules import GMVAE, SynergyDecoder
        >>> synergy_effects(SynergyDecoder.from_gmvae(GMVAE(39, 4))).shape
        torch.Size([4, 39])
    """
    one_at_a_time = torch.eye(decoder.num_synergies)
    change = _decode(decoder, one_at_a_time) - _decode(decoder, -one_at_a_time)
    return change / (decoder.high - decoder.low)


def direction_alignment(embedding: Tensor | ArrayLike, direction: Tensor | ArrayLike) -> float:
    """Whether episodes moved along their directions: mean cosine between φ(s) - mean φ and z.

    Near 0, the policy ignores its direction and exploration is undirected; the maximum is 1. For
    such a policy, it has a standard deviation of 1 / √(episodes · d).

    Args:
        embedding (Tensor or array): φ of the visited states [N, d].
        direction (Tensor or array): direction of each state's episode [N, d].

    Examples:
        >>> import torch
        >>> direction = torch.tensor([[1.0, 0.0], [-1.0, 0.0]])
        >>> round(direction_alignment(5.0 + 2.0 * direction, direction), 6)
        1.0
        >>> round(direction_alignment(torch.tensor([[0.0, 1.0], [0.0, -1.0]]), direction), 6)
        0.0
    """
    place = as_matrix(embedding, "embedding")
    place, way = place - place.mean(0), as_matrix(direction, "direction")
    if place.shape != way.shape:
        raise ValueError(
            f"embedding is {list(place.shape)} and direction {list(way.shape)}; pass a direction "
            "for each embedding, of the same size."
        )
    lengths = np.linalg.norm(place, axis=1) * np.linalg.norm(way, axis=1)
    return float(np.mean((place * way).sum(1) / np.maximum(lengths, 1e-12)))


_LEAST_VAF = 0.5  # of the better of model and PCA
_BEHIND_PCA = 0.02  # by how much the model's VAF may fall below PCA's
_LEAST_AUTHORITY = 0.2  # mean over actuators
_CURE = "; use more synergies, or another kind"
_UNDERFITTED = ": it is underfitted, so train it longer or lower the weight of its KL terms"
_CURES = {"gmvae": _UNDERFITTED, "vae": _UNDERFITTED}


def synergy_warnings(
    *, vaf: float, pca_vaf: float, authority: Tensor | ArrayLike, kind: str = "gmvae"
) -> list[str]:
    """Warnings about a synergy space, as sentences; an empty list if there are none.

    Keyword Args:
        vaf (float): variance accounted for by the synergy model.
        pca_vaf (float): variance accounted for by PCA with as many dimensions.
        authority (Tensor or array): result of :func:`control_authority` [n].
        kind (str): kind of the synergy model. Default: ``"gmvae"``.

    Examples:
        >>> synergy_warnings(vaf=0.9, pca_vaf=0.85, authority=[0.5, 0.7])
        []
        >>> for line in synergy_warnings(vaf=0.9, pca_vaf=0.85, authority=[0.004, 0.1]):
        ...     print(line)
        The synergies move an actuator over 5% of its range on average (at least 20% is
        advised; 1 of 2 actuators move less than 1%); learn with a residual, or fit the synergies
        to actions that vary more.
    """
    found, name = [], kind.upper()
    if max(vaf, pca_vaf) < _LEAST_VAF:
        found.append(
            f"The synergies explain little of the actions' variance: {vaf:.0%} by the {name} and "
            f"{pca_vaf:.0%} by PCA (at least {_LEAST_VAF:.0%} is advised); fit them to the "
            "policy's mean actions or to muscle activations instead of sampled actions, or raise "
            "the number of synergies."
        )
    if vaf < pca_vaf - _BEHIND_PCA:
        found.append(
            f"The {name} accounts for {vaf:.1%} of the actions' variance, less than PCA with the "
            f"same number of dimensions ({pca_vaf:.1%}){_CURES.get(kind, _CURE)}."
        )
    authority = as_array(authority)
    if authority.mean() < _LEAST_AUTHORITY:
        still = int((authority < 0.01).sum())
        idle = f"; {still} of {authority.size} actuators move less than 1%" if still else ""
        found.append(
            f"The synergies move an actuator over {authority.mean():.0%} of its range on average "
            f"(at least {_LEAST_AUTHORITY:.0%} is advised{idle}); learn with a residual, or fit "
            "the synergies to actions that vary more."
        )
    return found


def _decode(decoder: SynergyMap, synergies: Tensor) -> Tensor:
    silent = synergies.new_zeros(len(synergies), decoder.synergy_dim - decoder.num_synergies)
    return decoder(torch.cat([synergies, silent], -1).to(decoder.low.device))
