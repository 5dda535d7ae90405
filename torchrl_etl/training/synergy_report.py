"""What stage 1 found: numbers, warnings in words, and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_etl.analysis import (
    control_authority,
    embedding,
    mixture_usage,
    nmf_vaf,
    pca_vaf,
    synergy_heatmap,
    synergy_warnings,
    vaf_curve,
    variance_accounted_for,
)
from torchrl_etl.modules import GMVAE, SynergyDecoder
from torchrl_etl.modules.recorded_actions import as_actions
from torchrl_etl.objectives import GMVAELoss
from torchrl_etl.training.explore import ExploreStage
from torchrl_etl.training.stage import gradient_step

__all__ = ["describe_synergies", "draw_synergies", "fit_gmvae"]


def fit_gmvae(
    gmvae: GMVAE,
    actions: Tensor | np.ndarray,
    *,
    updates: int,
    batch_size: int = 256,
    lr: float = 3e-3,
    on_update: Callable[[], None] = lambda: None,
) -> GMVAE:
    """Train a GMVAE on an array of actions [N, n] by Eq. 9; returns it.

    Args:
        gmvae (GMVAE): trained in place.
        actions (array): [N, n], in action units: a tensor, a NumPy array or lists, of any real
            dtype.

    Keyword Args:
        updates, batch_size (int), lr (float): of Adam.
        on_update (callable): called before every update; may raise to stop.

    Raises:
        TypeError, ValueError: before anything is trained, if the actions are not numbers, have
            another width than the GMVAE, a value that is not finite or far outside of its bounds,
            or one row only.

    Examples:
        >>> import torch
        >>> from torchrl_etl.analysis import variance_accounted_for
        >>> _ = torch.manual_seed(0)
        >>> actions = torch.tanh(torch.randn(2048, 2) @ torch.randn(2, 8))
        >>> gmvae = fit_gmvae(GMVAE(8, latent_dim=2), actions, updates=300)
        >>> variance_accounted_for(actions, gmvae.reconstruct(actions).detach()) > 0.8
        True
    """
    actions = as_actions(actions, low=gmvae.low, high=gmvae.high, min_rows=2)
    loss_module = GMVAELoss(gmvae)
    optimizer = torch.optim.Adam(gmvae.parameters(), lr=lr, fused=True)
    for _ in range(updates):
        on_update()
        chosen = actions[torch.randint(len(actions), (batch_size,), device=actions.device)]
        loss = loss_module(TensorDict({"action": chosen}, [batch_size]))
        gradient_step(optimizer, loss["loss_gmvae"])
    return gmvae


@torch.no_grad()
def describe_synergies(
    gmvae: GMVAE, decoder: SynergyDecoder, actions: Tensor
) -> tuple[dict[str, float], list[str]]:
    """Numbers of a synergy space on the actions [N, n] it was fitted to, and its warnings.

    Returns:
        dict: ``vaf``, ``pca_vaf`` and ``nmf_vaf`` at the same d, ``control_authority`` (mean share
        of an actuator's range that the decoder commands) and ``effective_components``.
        list of str: what is wrong with it, in words.
    """
    authority = control_authority(decoder)
    usage = mixture_usage(gmvae, actions)
    vaf = variance_accounted_for(actions, gmvae.reconstruct(actions))
    pca = pca_vaf(actions, gmvae.latent_dim)
    numbers = {
        "vaf": vaf,
        "pca_vaf": pca,
        "nmf_vaf": nmf_vaf(actions, gmvae.latent_dim, low=gmvae.low),
        "control_authority": authority.mean().item(),
        "effective_components": usage.effective,
    }
    return numbers, synergy_warnings(vaf=vaf, pca_vaf=pca, authority=authority, usage=usage)


def draw_synergies(
    stage: ExploreStage,
    decoder: SynergyDecoder,
    names: Sequence[str],
    folder: Path,
    *,
    dims: Sequence[int],
    updates: int,
    on_update: Callable[[], None] = lambda: None,
) -> None:
    """Heat map over named muscles, VAF against d beside PCA and NMF, state embedding.

    Args:
        stage (ExploreStage): a finished stage.
        decoder (SynergyDecoder): its decoder.
        names (sequence of str): actuators, in action order.
        folder (path): where the PNGs go.

    Keyword Args:
        dims (sequence of int): numbers of synergies on the VAF curve; those above n are left out.
        updates (int): updates that a fresh GMVAE gets at every d, the same for all, so that the
            curve compares dimensions and not training times; the stage's own had more.
        on_update (callable): called before every update; may raise to stop.
    """
    synergy_heatmap(decoder, names, folder / "synergies.png")

    actions, gmvae = stage.actions(), stage.gmvae
    dims = sorted({d for d in (*dims, gmvae.latent_dim) if d <= gmvae.action_dim})
    series: dict[str, list[float]] = {"GMVAE": [], "PCA": [], "NMF": []}
    with torch.random.fork_rng():
        for d in dims:
            fresh = GMVAE(
                gmvae.action_dim, d, gmvae.num_components, low=gmvae.low, high=gmvae.high
            ).to(actions.device)
            fit_gmvae(fresh, actions, updates=updates, on_update=on_update)
            with torch.no_grad():
                series["GMVAE"].append(variance_accounted_for(actions, fresh.reconstruct(actions)))
            series["PCA"].append(pca_vaf(actions, d))
            series["NMF"].append(nmf_vaf(actions, d, low=gmvae.low))
    vaf_curve(dims, series, folder / "vaf.png", chosen_d=gmvae.latent_dim)

    visited = stage.newest(5000)
    with torch.no_grad():
        embedded = stage.encoder(visited.select("observation"))["embedding"]
    embedding(embedded, visited["direction"], folder / "embedding.png")
