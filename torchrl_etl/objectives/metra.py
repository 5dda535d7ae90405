"""METRA's loss for a state encoder, which bounds the scale of φ by the length of a step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from torchrl_etl import functional
from torchrl_etl.checks import check_choice, check_real
from torchrl_etl.objectives.checks import check_parts, read

__all__ = ["METRALoss"]


class METRALoss(LossModule):
    r"""Loss that spreads state embeddings along the directions, with steps no longer than 1.

    The bonus of Eq. 1 telescopes to a displacement, so its size depends on the scale of φ. Here φ
    maximizes the bonus under a bound on ‖φ(s') - φ(s)‖. Distances of embeddings are then lower
    bounds on the number of steps between states (Park 2024). It can replace
    :class:`~torchrl_etl.objectives.BehavioralMetricLoss` in stage 1. It reads no reward, compares
    the two ends of a transition instead of pairs of transitions, and needs no target network.

    Equation: φ maximises ``⟨φ(s') - φ(s), z⟩ + λ min(ε, 1 - ‖φ(s') - φ(s)‖²)``; λ minimises
    ``log λ · min(ε, 1 - ‖φ(s') - φ(s)‖²)``, the other factor held fixed.

    Keys:
        reads the encoder's ``in_keys`` (``observation`` [*, O]), the same below ``"next"``, and
        ``direction`` [*, k], a unit vector. Writes

        - ``loss_representation``: for φ, the objective above negated;
        - ``loss_lambda``: for λ, which rises where steps are too long and falls where they are
          not, with a gradient of at most ε;
        - ``mean_bonus``: Eq. 1 over the batch, detached;
        - ``mean_step``: length of the steps ‖φ(s') - φ(s)‖ over the batch, detached;
        - ``multiplier``: λ, detached;
        - ``effective_rank``: of the embeddings, detached; near 1 means one used dimension.

    Deviates:
        - ``norm="sum"`` bounds ‖φ(s') - φ(s)‖² by 1, as in METRA's paper, so that the bonus lies in
          [-1, 1] for every k. METRA's public code takes the mean over dimensions
          (``norm="mean"``), which lets steps grow to √k.
        - λ is updated through its logarithm, as in METRA's public code: it stays positive, and its
          gradient does not contain λ as a factor.

    Args:
        encoder (TensorDictModule): φ; its first out key is the embedding [*, k].

    Keyword Args:
        epsilon (float): ε, positive: slack of the bound beyond which φ gains nothing from shorter
            steps. Default: ``1e-3``.
        lambda_init (float): initial λ, positive. Default: ``30.0``.
        norm (str): ``"sum"`` or ``"mean"`` of squares over dimensions. Default: ``"sum"``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"`` (one value per sample).
            Default: ``"mean"``.

    Raises:
        ValueError: at construction for an unknown choice or a number out of range; in ``forward``
            if embedding and direction differ in size.
        TypeError: if the encoder is not a TensorDict module.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import StateEncoder
        >>> from torchrl_etl.objectives.metra import METRALoss
        >>> loss = METRALoss(StateEncoder(observation_dim=7, embedding_dim=4))
        >>> batch = TensorDict({"observation": torch.randn(32, 7)}, [32])
        >>> batch["direction"] = torch.eye(4).repeat(8, 1)
        >>> batch["next", "observation"] = torch.randn(32, 7)
        >>> out = loss(batch)
        >>> (out["loss_representation"] + out["loss_lambda"]).backward()
        >>> round(out["multiplier"].item(), 3)
        30.0
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change.

        Attributes:
            direction (NestedKey): the episode's direction. Default: ``"direction"``.
        """

        direction: NestedKey = "direction"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        *,
        epsilon: float = 1e-3,
        lambda_init: float = 30.0,
        norm: Literal["sum", "mean"] = "sum",
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        check_choice("norm", norm, ("sum", "mean"))
        check_choice("reduction", reduction, ("mean", "sum", "none"))
        check_parts("encoder", encoder, TensorDictModuleBase, outputs=1)
        check_real("(0, inf)", epsilon=epsilon, lambda_init=lambda_init)
        super().__init__()
        self.epsilon, self.lambda_init = epsilon, lambda_init
        self.norm, self.reduction = norm, reduction
        self.convert_to_functional(encoder, "encoder")
        self.log_lambda = nn.Parameter(torch.tensor(math.log(lambda_init)))
        self._set_in_keys()
        self.out_keys = [
            "loss_representation",
            "loss_lambda",
            "mean_bonus",
            "mean_step",
            "multiplier",
            "effective_rank",
        ]

    def _set_in_keys(self) -> None:
        self.in_keys = [
            *self.encoder.in_keys,
            self.tensor_keys.direction,
            *(unravel_key(("next", key)) for key in self.encoder.in_keys),
        ]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The entries listed under ``Keys``, for a batch of any size, which is not modified."""
        name = type(self).__name__
        direction = read(name, tensordict, self.tensor_keys.direction).detach()
        batch_size = direction.shape[:-1]
        embedding = self._embed(tensordict, batch_size)
        next_embedding = self._embed(read(name, tensordict, "next"), batch_size)
        if embedding.shape[-1] != direction.shape[-1]:
            raise ValueError(
                f"The encoder's embedding has {embedding.shape[-1]} dimensions but the direction "
                f"has {direction.shape[-1]}; give DirectionPrimer and encoder the same "
                "embedding_dim."
            )
        bonus = functional.direction_bonus(embedding, next_embedding, direction).squeeze(-1)
        square = (next_embedding - embedding).square()
        length = square.sum(-1)
        room = 1.0 - (length if self.norm == "sum" else square.mean(-1))
        room = room.clamp_max(self.epsilon)
        multiplier = self.log_lambda.detach().exp()
        out = {
            "loss_representation": -(bonus + multiplier * room),
            "loss_lambda": self.log_lambda * room.detach(),
        }
        return TensorDict(
            {key: self._reduce_loss(value, tensordict) for key, value in out.items()}
            | {
                "mean_bonus": bonus.detach().mean(),
                "mean_step": length.detach().sqrt().mean(),
                "multiplier": multiplier,
                "effective_rank": functional.effective_rank(embedding.detach()),
            }
        )

    def _embed(self, tensordict: TensorDictBase, batch_size: torch.Size) -> Tensor:
        """Embeddings [*, k]."""
        # A tensordict with observations only may count their last size as a batch size.
        inputs = TensorDict({key: tensordict[key] for key in self.encoder.in_keys}, batch_size)
        with self.encoder_params.to_module(self.encoder, preserve_module_state=False):
            written = self.encoder(inputs)
        return written.get(self.encoder.out_keys[0])

    def reset_parameters_recursive(self) -> None:
        """Reinitialize encoder and λ."""
        super().reset_parameters_recursive()
        with torch.no_grad():
            self.log_lambda.fill_(math.log(self.lambda_init))
