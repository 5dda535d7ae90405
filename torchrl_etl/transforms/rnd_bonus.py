"""The bonus of random network distillation for environments, buffers and tensordicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import RNDLoss

from torchrl_etl.transforms.scaled_bonus import ScaledBonus

__all__ = ["RNDBonus"]


class RNDBonus(ScaledBonus):
    """Rewards observations whose random features are not yet predicted (RND, Burda 2018).

    Like :class:`~torchrl_etl.transforms.IntrinsicReward` it works on an env, a tensordict, a replay
    buffer or in a learner; the last two give every *sampled* batch the current predictor's error.
    TorchRL's loss computes the error. Its networks and statistics are held by reference and not
    saved here. Each call first updates the loss's statistics with its observations. TorchRL's own
    ``RNDTransform`` is for environments alone, see ``docs/torchrl_notes.md``.

    Equation: b = mean_j (f_j(ō') - g_j(ō'))² with the random target g, its predictor f, and ō the
    observation normalized by its running mean and deviation, clipped.

    Deviates: the paper divides by the deviation of the discounted sum of bonuses and has separate
    critics for bonus and reward, the bonus's without ends of episodes. Here the bonus is divided by
    its own running deviation, as in :class:`~torchrl_etl.transforms.IntrinsicReward`, and the same
    critics value both.

    Args:
        loss (RNDLoss): the loss that trains the predictor.

    Keyword Args:
        in_key (NestedKey): the observation. Default: ``"observation"``.
        out_key (NestedKey): Default: ``"intrinsic_reward"``.
        **scale: see :class:`~torchrl_etl.transforms.ScaledBonus`.

    Keys:
        reads ``("next", "observation")`` [*, O] and, with an extrinsic weight, ``("next",
        "reward")`` [*, 1]; writes ``("next", "intrinsic_reward")`` [*, 1], in standard deviations
        where normalized.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch.nn import Linear
        >>> from torchrl.objectives import RNDLoss
        >>> from torchrl_etl.transforms import RNDBonus
        >>> bonus = RNDBonus(RNDLoss(Linear(3, 8), Linear(3, 8)))
        >>> data = TensorDict({"observation": torch.randn(8, 3)}, [8])
        >>> data["next"] = {"observation": torch.randn(8, 3)}
        >>> bool((bonus(data)["next", "intrinsic_reward"] > 0).all())
        True
    """

    _remedy = "name the right one in in_key."

    def __init__(
        self,
        loss: RNDLoss,
        *,
        in_key: NestedKey = "observation",
        out_key: NestedKey = "intrinsic_reward",
        **scale: Any,
    ) -> None:
        super().__init__([in_key], out_key, **scale)
        error = RNDLoss(
            loss.predictor_network,
            loss.target_network,
            obs_rms=loss.obs_rms,
            obs_clip=loss.obs_clip,
            reduction="none",
            update_fraction=1.0,
        )
        # In a tuple, since a submodule would follow the env's device and be saved twice.
        self._error = (error,)

    @property
    def networks(self) -> Sequence[nn.Module]:
        return self._error

    @property
    def _typed_by(self) -> NestedKey:
        return self.in_keys[0]

    def _bonus(
        self, observation: Tensor, next_observation: Tensor, tensordict: TensorDictBase
    ) -> Tensor:
        (error,) = self._error
        # StackedLearners replaces parameters by stacked tensors, so there may be none.
        seen = next_observation.to(next(error.parameters(), next_observation).device)
        if error.obs_rms is not None and self.update_statistics:
            error.obs_rms.update(seen)
        rows = TensorDict({"next": {"observation": seen}}, seen.shape[:-1])
        return error(rows)["loss_predictor"].unsqueeze(-1).to(next_observation)
