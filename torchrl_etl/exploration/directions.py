"""Exploration along directions of a state embedding (Eq. 1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from torchrl_etl.checks import naming, renaming
from torchrl_etl.envs import EnvironmentSpec
from torchrl_etl.exploration.exploration import Exploration
from torchrl_etl.modules import StateEncoder
from torchrl_etl.transforms import DirectionPrimer, IntrinsicReward, RedrawDirection

__all__ = ["DirectionExploration"]


class DirectionExploration(Exploration):
    """Each episode follows a direction z, with a bonus for moving the embedding φ along it.

    Subclasses train φ. Sampled batches are relabeled with other directions, since Eq. 1 rewards
    any step along any direction.

    Equation: 1, r^b = ⟨φ(s') - φ(s), z⟩.

    Keyword Args:
        encoder, direction, bonus (mapping): keyword arguments of
            :class:`~torchrl_etl.modules.StateEncoder`,
            :class:`~torchrl_etl.transforms.DirectionPrimer` and
            :class:`~torchrl_etl.transforms.IntrinsicReward`.
        relabel (float): share of each batch that is relabeled with new directions, see
            :class:`~torchrl_etl.transforms.RedrawDirection`.
    """

    reward = "intrinsic_reward"
    keep = ("direction", ("next", "direction"))

    def __init__(
        self,
        spec: EnvironmentSpec,
        *,
        encoder: Mapping[str, Any],
        direction: Mapping[str, Any],
        bonus: Mapping[str, Any],
        relabel: float = 1.0,
    ) -> None:
        super().__init__(spec)
        with naming("encoder"):
            self.encoder = StateEncoder(spec.observation_dim, **encoder).to(spec.device)
        self.inputs = {"direction": self.encoder.embedding_dim}
        with naming("direction"):
            self.primer = DirectionPrimer(self.encoder.embedding_dim, **direction)
        with renaming(share="relabel"):
            self._redraw = RedrawDirection(self.primer.clone(), share=relabel)
        with naming("bonus"):
            self._bonus = IntrinsicReward(self.encoder, **bonus)

    def reset_transforms(self) -> Sequence[Transform]:
        return (self.primer,)

    def relabel_transforms(self) -> Sequence[Transform]:
        return (self._redraw,)

    def batch_transforms(self) -> Sequence[Transform]:
        return (self._bonus,)

    @torch.no_grad()
    def embed(self, rows: TensorDictBase) -> tuple[Tensor, Tensor]:
        device = next(self.encoder.parameters()).device
        return self.encoder(rows["observation"].to(device)), rows["direction"]
