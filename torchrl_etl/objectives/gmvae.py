"""Fitting the Gaussian-mixture VAE of actions (Eq. 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from torchrl_etl import functional
from torchrl_etl.checks import check_choice, check_real
from torchrl_etl.draws import standard_normal
from torchrl_etl.modules import GMVAE
from torchrl_etl.objectives.checks import check_parts, read

__all__ = ["GMVAELoss"]


class GMVAELoss(LossModule):
    r"""Negative variational bound of a Gaussian-mixture VAE on actions.

    Equation: 9, negated to be minimized, as printed if both weights are 1. With one component it is
    the loss of an ordinary VAE ("ETL w/o GM").

    Keys:
        reads ``action`` [*, n] in action units. Writes ``loss_gmvae``, and detached batch means in
        nats: ``reconstruction`` (log-likelihood of the action scaled to [-1, 1]), ``latent_kl``,
        ``component_kl`` and ``component_entropy``, the entropy of the batch's average ``q(c|a)``:
        log C when all components are used equally, 0 when only one is used.

    Deviates: the expectation over components is exact, the likelihood is Gaussian with a learned
        scale, and the prior means are learned; the paper leaves all three open.

    Args:
        gmvae (GMVAE): the model.

    Keyword Args:
        kl_weight (float): weight of KL(q(z|a,c) ‖ p(z|c)). Default: ``1.0``.
        component_kl_weight (float): weight of KL(q(c|a) ‖ p(c)). Default: ``1.0``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Default: ``"mean"``.

    Raises:
        ValueError: for an unknown reduction or a negative weight.
        TypeError: if ``gmvae`` is not a :class:`~torchrl_etl.modules.GMVAE`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import GMVAE
        >>> from torchrl_etl.objectives import GMVAELoss
        >>> loss = GMVAELoss(GMVAE(action_dim=39, latent_dim=4))
        >>> out = loss(TensorDict({"action": 2 * torch.rand(64, 39) - 1}, [64]))
        >>> out["loss_gmvae"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change.

        Attributes:
            action (NestedKey): the action to represent. Default: ``"action"``.
        """

        action: NestedKey = "action"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    gmvae: GMVAE
    gmvae_params: TensorDictParams
    target_gmvae_params: TensorDictParams

    def __init__(
        self,
        gmvae: GMVAE,
        *,
        kl_weight: float = 1.0,
        component_kl_weight: float = 1.0,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        check_choice("reduction", reduction, ("mean", "sum", "none"))
        check_parts("gmvae", gmvae, GMVAE)
        check_real("[0, inf)", kl_weight=kl_weight, component_kl_weight=component_kl_weight)
        super().__init__()
        self.kl_weight, self.component_kl_weight = kl_weight, component_kl_weight
        self.reduction = reduction
        self.convert_to_functional(gmvae, "gmvae")
        self._set_in_keys()
        self.out_keys = [
            "loss_gmvae",
            "reconstruction",
            "latent_kl",
            "component_kl",
            "component_entropy",
        ]

    def _set_in_keys(self) -> None:
        self.in_keys = [self.tensor_keys.action]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The entries listed under ``Keys``, for a batch of any size, which is not modified."""
        action = read(type(self).__name__, tensordict, self.tensor_keys.action).detach()
        gmvae = self.gmvae
        with self.gmvae_params.to_module(gmvae, preserve_module_state=False):
            posterior = gmvae.encode(action)
            # Sampled by hand: inside a loss, TorchRL's distributions return their mode as sample.
            latent = posterior.loc + posterior.scale * standard_normal(posterior.loc)
            terms = functional.gmvae_bound(
                gmvae.normalize(action),
                gmvae.decoder.unit(latent),
                gmvae.likelihood_scale,
                *posterior,
                gmvae.prior_loc,
                gmvae.prior_scale,
            )
        loss = (
            self.kl_weight * terms.latent_kl
            + self.component_kl_weight * terms.component_kl
            - terms.reconstruction
        )
        usage = posterior.logits.detach().softmax(-1).flatten(0, -2).mean(0)
        return TensorDict(
            {
                "loss_gmvae": self._reduce_loss(loss, tensordict),
                "reconstruction": terms.reconstruction.detach().mean(),
                "latent_kl": terms.latent_kl.detach().mean(),
                "component_kl": terms.component_kl.detach().mean(),
                "component_entropy": torch.special.entr(usage).sum(),
            }
        )

    def reset_parameters_recursive(self) -> None:
        """Reinitialize the model, including its prior."""
        with self.gmvae_params.to_module(self.gmvae, preserve_module_state=False):
            config = self.gmvae.config
        self.from_stateful_net("gmvae", GMVAE(**config).to(self._default_device))
