"""Fit synergies to any array of actions or muscle activity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from torchrl_etl.checks import check_integer
from torchrl_etl.modules.recorded_actions import as_actions, as_bounds
from torchrl_etl.synergies.gmvae import GMVAESynergies
from torchrl_etl.synergies.model import SynergyModel
from torchrl_etl.synergies.nmf import NMFSynergies
from torchrl_etl.synergies.pca import PCASynergies
from torchrl_etl.synergies.sar import SARSynergies
from torchrl_etl.synergies.vae import VAESynergies
from torchrl_etl.user_code import find_class

__all__ = ["SYNERGY_MODELS", "fit_synergies"]

SYNERGY_MODELS: Mapping[str, type[SynergyModel]] = {
    model.kind: model
    for model in (GMVAESynergies, VAESynergies, PCASynergies, NMFSynergies, SARSynergies)
}
"""Kinds of synergies by name; ``"my_module:MySynergies"`` names a user's own."""


def fit_synergies(
    actions: Tensor | np.ndarray | Sequence[Any],
    kind: str | type[SynergyModel] = "gmvae",
    num_synergies: int = 4,
    *,
    low: float | Sequence[float] | Tensor = -1.0,
    high: float | Sequence[float] | Tensor = 1.0,
    updates: int | None = None,
    **options: Any,
) -> SynergyModel:
    """Find synergies in an array of actions, EMG or muscle activations [N, n].

    Args:
        actions (array): [N, n] between the bounds: a tensor, a NumPy array or lists.
        kind (str or type): ``"gmvae"``, ``"vae"``, ``"pca"``, ``"nmf"`` or ``"sar"``, see
            :data:`~torchrl_etl.synergies.SYNERGY_MODELS`; for your own model, its class or
            ``"my_module:MySynergies"``.
        num_synergies (int): d, at most n.

    Keyword Args:
        low, high (float, sequence of float or Tensor): bounds, scalar or [n]; 0 and 1 for
            normalized EMG. Default: -1 and 1.
        updates (int, optional): training updates, for a kind that trains. Default: the model's own.
        **options: keyword arguments of the model's class.

    Returns:
        SynergyModel: the fitted model; ``model.save(path, actions, ...)`` writes its bundle.

    Raises:
        TypeError, ValueError: before anything is fitted, if the kind is unknown or takes no
            ``updates``, or actions or bounds do not fit (see
            :func:`~torchrl_etl.modules.recorded_actions.as_actions`).

    Examples:
        >>> import numpy as np
        >>> from torchrl_etl.analysis import variance_accounted_for
        >>> rng = np.random.default_rng(0)
        >>> emg = rng.random((500, 3)) @ rng.random((3, 12)) / 3  # three sources, twelve muscles
        >>> model = fit_synergies(emg, kind="nmf", num_synergies=3, low=0.0, high=1.0)
        >>> variance_accounted_for(emg, model.reconstruct(emg)) > 0.99
        True
        >>> model.decoder(emg).action_dim
        12
    """
    if not isinstance(kind, type):
        kind = find_class(kind, SYNERGY_MODELS, SynergyModel)
    try:
        width = np.shape(actions)[-1]
    except (ValueError, IndexError):  # ragged lists or a number: refused by as_actions
        width = 1
    low, high = as_bounds(low, high, width)
    found = as_actions(actions, low=low, high=high, min_rows=2)
    model = kind(low, high, num_synergies, **options)
    if updates is not None:
        if model.updates is None:
            raise TypeError(
                f"updates is {updates}, but {kind.__name__} does not train; leave it out."
            )
        check_integer(1, updates=updates)
        model.updates = updates
    model.fit(found)
    return model
