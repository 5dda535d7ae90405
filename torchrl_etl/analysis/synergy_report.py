"""Report on the synergies of stage 1: numbers, warnings and plots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_etl.analysis.diagnostics import control_authority, synergy_warnings
from torchrl_etl.analysis.pictures import synergy_heatmap, vaf_curve
from torchrl_etl.analysis.variance import nmf_vaf, pca_vaf, variance_accounted_for
from torchrl_etl.modules import SynergyMap
from torchrl_etl.synergies import SynergyModel

__all__ = ["describe_synergies", "draw_synergies"]


@torch.no_grad()
def describe_synergies(
    model: SynergyModel, decoder: SynergyMap, actions: Tensor
) -> tuple[dict[str, Any], list[str]]:
    """Metrics of a synergy space on the actions [N, n] it was fitted to, and its warnings.

    Returns:
        dict: ``vaf``, ``pca_vaf`` and ``nmf_vaf`` at the same d, ``control_authority`` (mean over
        actuators), and the metrics of
        :meth:`SynergyModel.describe <torchrl_etl.synergies.SynergyModel.describe>`.
        list of str: warnings, as sentences.
    """
    authority = control_authority(decoder)
    vaf = variance_accounted_for(actions, model.reconstruct(actions))
    pca = pca_vaf(actions, model.num_synergies)
    own, faults = model.describe(actions)
    numbers: dict[str, Any] = {
        "vaf": vaf,
        "pca_vaf": pca,
        "nmf_vaf": nmf_vaf(actions, model.num_synergies, low=decoder.low),
        "control_authority": authority.mean().item(),
        **own,
    }
    found = synergy_warnings(vaf=vaf, pca_vaf=pca, authority=authority, kind=model.kind)
    return numbers, found + faults


def draw_synergies(
    make_model: Callable[[int], SynergyModel],
    decoder: SynergyMap,
    actions: Tensor,
    names: Sequence[str],
    folder: Path,
    *,
    dims: Sequence[int],
    on_update: Callable[[], None] = lambda: None,
) -> None:
    """Plot a heat map of the synergies, and VAF against d in comparison with PCA and NMF.

    Args:
        make_model (callable): makes a new synergy model with the given number of synergies.
        decoder (SynergyMap): decoder of the fitted model.
        actions (Tensor): actions that the model was fitted to [N, n].
        names (sequence of str): names of the actuators, in action order.
        folder (path): folder of the PNGs.

    Keyword Args:
        dims (sequence of int): numbers of synergies on the VAF curve; those above n are left out.
            A new model is fitted for every d, so that all have the same training time.
        on_update (callable): called before every update; may raise to stop.
    """
    synergy_heatmap(decoder, names, folder / "synergies.png")
    dims = sorted({d for d in (*dims, decoder.num_synergies) if d <= decoder.action_dim})
    kind = make_model(1).kind.upper()
    series: dict[str, list[float]] = {kind: [], "PCA": [], "NMF": []}
    with torch.random.fork_rng():
        for d in dims:
            model = make_model(d)
            model.fit(actions, on_update=on_update)
            with torch.no_grad():
                vaf = variance_accounted_for(actions, model.reconstruct(actions))
            series[kind].append(vaf)
            if kind != "PCA":
                series["PCA"].append(pca_vaf(actions, d))
            if kind != "NMF":
                series["NMF"].append(nmf_vaf(actions, d, low=decoder.low))
    vaf_curve(dims, series, folder / "vaf.png", chosen_d=decoder.num_synergies)
