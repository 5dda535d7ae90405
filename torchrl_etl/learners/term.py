"""An additional loss of a learner."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_etl.checks import check_real
from torchrl_etl.objectives import FusedSoftUpdate

__all__ = ["Term"]


class Term(nn.Module):
    """A loss that a learner minimizes besides SAC's, on the same batch with the same optimizer.

    Args:
        loss (LossModule): writes entries ``loss_*``, which are summed, and scalars to log.

    Keyword Args:
        weight (float): weight of the summed losses; at 0 they are only logged. Default: 1.
        lr (float, optional): learning rate of the loss's parameters. Default: the learner's.
        tau (float, optional): EMA rate of the loss's target networks.
            Default: ``None``, no target networks.
        inputs (callable, optional): maps a batch to the input of the loss. Default: identity.

    Raises:
        ValueError: if the weight is negative, the learning rate is not positive, or tau is outside
            (0, 1].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.learners import Term
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> from torchrl_etl.objectives import DecoderLoss
        >>> term = Term(DecoderLoss(SynergyDecoder(2, 6)), weight=0.1, lr=3e-5)
        >>> batch = TensorDict({"synergy": torch.zeros(4, 2), "action": torch.zeros(4, 6)}, [4])
        >>> loss, scalars = term(batch)
        >>> bool(loss == 0.1 * scalars["loss_decoder"])
        True
    """

    def __init__(
        self,
        loss: LossModule,
        *,
        weight: float = 1.0,
        lr: float | None = None,
        tau: float | None = None,
        inputs: Callable[[TensorDictBase], TensorDictBase] | None = None,
    ) -> None:
        check_real("[0, inf)", weight=weight)
        if lr is not None:
            check_real("(0, inf)", lr=lr)
        if tau is not None:
            check_real("(0, 1]", tau=tau)
        super().__init__()
        self.loss, self.weight, self.lr, self.inputs = loss, weight, lr, inputs
        self.target = None if tau is None else FusedSoftUpdate(loss, tau=tau)

    def forward(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        """The weighted loss, and scalars to log."""
        out = self.loss(batch if self.inputs is None else self.inputs(batch))
        losses = [value for key, value in out.items() if key.startswith("loss_")]
        return self.weight * sum(losses), out
