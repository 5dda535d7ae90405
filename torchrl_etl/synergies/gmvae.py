"""Synergies of a Gaussian-mixture VAE, as in the paper (Eqs. 7 to 9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_etl.checks import check_integer, check_real, check_sizes
from torchrl_etl.modules import GMVAE, SynergyDecoder
from torchrl_etl.modules.recorded_actions import as_actions
from torchrl_etl.objectives import GMVAELoss
from torchrl_etl.synergies.model import SynergyModel, check_num_synergies

__all__ = ["GMVAESynergies", "component_shares", "fit_gmvae"]

_LEAST_COMPONENTS = 1.5


class GMVAESynergies(SynergyModel):
    """A :class:`~torchrl_etl.modules.GMVAE` and its loss.

    Args:
        low, high (Tensor): bounds of the action [n].
        num_synergies (int): d.

    Keyword Args:
        num_components (int, optional): mixture components. Default: d; 1 is an ordinary VAE.
        hidden (sequence of int): widths of the hidden layers.
        lr (float): learning rate.
        kl_weight, component_kl_weight (float): see :class:`~torchrl_etl.objectives.GMVAELoss`.
        updates (int): number of updates in :meth:`fit`.
    """

    kind = "gmvae"
    updates: int = 2000
    loss: GMVAELoss

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        num_synergies: int,
        *,
        num_components: int | None = None,
        hidden: Sequence[int] = (128, 128),
        lr: float = 3e-3,
        kl_weight: float = 1.0,
        component_kl_weight: float = 1.0,
        updates: int = 2000,
    ) -> None:
        check_real("(0, inf)", lr=lr)
        check_sizes(hidden=hidden)
        check_integer(1, updates=updates)
        check_num_synergies(num_synergies, len(low))
        self.num_synergies, self.lr, self.updates = num_synergies, lr, updates
        self.model = GMVAE(
            len(low),
            num_synergies,
            num_components,
            low=low.tolist(),
            high=high.tolist(),
            hidden=hidden,
        ).to(low.device)
        self.loss = GMVAELoss(
            self.model, kl_weight=kl_weight, component_kl_weight=component_kl_weight
        )

    def fit(self, actions: Tensor, *, on_update: Callable[[], None] = lambda: None) -> None:
        self.loss.reset_parameters_recursive()
        fit_gmvae(
            self.model,
            actions,
            updates=self.updates,
            lr=self.lr,
            loss=self.loss,
            on_update=on_update,
        )

    def decoder(self, actions: Tensor, *, residual: float = 0.0) -> SynergyDecoder:
        return SynergyDecoder.from_gmvae(self.model, actions, residual=residual)

    def reconstruct(self, actions: Tensor) -> Tensor:
        return self.model.reconstruct(actions)

    def describe(self, actions: Tensor) -> tuple[dict[str, float], list[str]]:
        """``effective_components``: exp of the entropy of the mean q(c|a); warns of a collapse."""
        shares = component_shares(self.model, actions)
        effective = torch.special.entr(shares).sum().exp().item()
        faults = []
        if len(shares) > 1 and effective < _LEAST_COMPONENTS:
            faults.append(
                f"The mixture has collapsed: {effective:.1f} of its {len(shares)} components are "
                f"in use, the largest for {float(shares.max()):.0%} of the actions; lower the "
                "weight of the component KL, or ask for fewer components."
            )
        return {"effective_components": effective}, faults


@torch.no_grad()
def component_shares(gmvae: GMVAE, actions: Tensor | np.ndarray) -> Tensor:
    """Share of the actions [N, n] in each component [C]: mean q(c|a).

    Examples:
        >>> component_shares(GMVAE(39, 4), torch.rand(64, 39)).sum().round()
        tensor(1.)
    """
    actions = as_actions(actions, low=gmvae.low, high=gmvae.high)
    # In chunks: hidden layers of all actions at once would take far more memory than the result.
    totals = (gmvae.encode(part).logits.softmax(-1).sum(0) for part in actions.split(8192))
    return sum(totals, torch.zeros(())) / len(actions)


def fit_gmvae(
    gmvae: GMVAE,
    actions: Tensor | np.ndarray,
    *,
    updates: int,
    batch_size: int = 256,
    lr: float = 3e-3,
    loss: GMVAELoss | None = None,
    on_update: Callable[[], None] = lambda: None,
) -> GMVAE:
    """Train a GMVAE on an array of actions [N, n] by Eq. 9; returns it.

    Args:
        gmvae (GMVAE): trained in place.
        actions (array): [N, n], in action units: a tensor, a NumPy array or lists, of any real
            dtype.

    Keyword Args:
        updates, batch_size (int), lr (float): options of the training with Adam.
        loss (GMVAELoss, optional): loss of this GMVAE. Default: both weights at 1.
        on_update (callable): called before every update; may raise to stop.

    Raises:
        TypeError, ValueError: before training, if the actions are not numbers, do not have the
            width of the GMVAE, are not finite, lie far outside its bounds, or have only one row; if
            a number is not positive, or the loss belongs to another GMVAE.

    Examples:
        >>> import torch
        >>> from torchrl_etl.analysis import variance_accounted_for
        >>> _ = torch.manual_seed(0)
        >>> actions = torch.tanh(torch.randn(2048, 2) @ torch.randn(2, 8))
        >>> gmvae = fit_gmvae(GMVAE(8, latent_dim=2), actions, updates=300)
        >>> variance_accounted_for(actions, gmvae.reconstruct(actions).detach()) > 0.8
        True
    """
    check_integer(1, updates=updates, batch_size=batch_size)
    actions = as_actions(actions, low=gmvae.low, high=gmvae.high, min_rows=2)
    loss = GMVAELoss(gmvae) if loss is None else loss
    if loss.gmvae_params["prior_loc"] is not gmvae.prior_loc:
        raise ValueError("loss is for another GMVAE; pass GMVAELoss(gmvae), or leave it out.")
    optimizer = torch.optim.Adam(gmvae.parameters(), lr=lr, fused=True)
    for _ in range(updates):
        on_update()
        chosen = actions[torch.randint(len(actions), (batch_size,), device=actions.device)]
        optimizer.zero_grad(set_to_none=True)
        loss(TensorDict({"action": chosen}, [batch_size]))["loss_gmvae"].backward()
        optimizer.step()
    return gmvae
