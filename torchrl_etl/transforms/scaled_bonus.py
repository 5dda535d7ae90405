"""A bonus plus the task's reward, each divided by its running deviation."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from torchrl_etl.checks import check_flag, check_real
from torchrl_etl.modules.running_deviation import RunningDeviation
from torchrl_etl.transforms.transition_reward import TransitionReward

__all__ = ["ScaledBonus"]


class ScaledBonus(TransitionReward):
    """Writes bonus / σ + weight · reward / σ', with running deviations.

    A subclass computes the bonus in ``_bonus``.

    Args:
        in_keys (sequence of NestedKey): inputs of the bonus; the first is the observation.
        out_key (NestedKey): key of the sum, below ``"next"``.

    Keyword Args:
        normalize (bool): divide bonus and task reward by their running standard deviations.
            Default: ``True``.
        decay (float): in (0, 1); a call (one env step or one sampled batch) has weight
            ``1 - decay`` in the running statistics. Default: 0.99.
        extrinsic_weight (float): weight of the task's reward. Default: 0.
        reward_key (NestedKey): the task's reward, read where ``extrinsic_weight`` is not 0.
            Default: ``"reward"``.
        update_statistics (bool): whether calls update the running statistics. The attribute can be
            set at any time; in a compiled learner, before its first update. Train and eval mode
            have no effect, since TorchRL puts transforms of envs and buffers in eval mode.
            Default: ``True``.

    Raises:
        ValueError: if ``decay`` is used and outside (0, 1), or ``extrinsic_weight`` is negative.
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        out_key: NestedKey,
        *,
        normalize: bool = True,
        decay: float = 0.99,
        extrinsic_weight: float = 0.0,
        reward_key: NestedKey = "reward",
        update_statistics: bool = True,
    ) -> None:
        check_flag(normalize=normalize, update_statistics=update_statistics)
        check_real("[0, inf)", extrinsic_weight=extrinsic_weight)
        super().__init__(in_keys=list(in_keys), out_keys=[out_key])
        self.deviation = RunningDeviation(decay) if normalize else None
        self.reward_deviation = RunningDeviation(decay) if normalize and extrinsic_weight else None
        self.extrinsic_weight = extrinsic_weight
        self.reward_key = unravel_key(reward_key)
        self.update_statistics = update_statistics

    @abstractmethod
    def _bonus(
        self, observation: Tensor, next_observation: Tensor, tensordict: TensorDictBase
    ) -> Tensor:
        """The bonus [*, 1] before scaling; ``tensordict`` is the root."""

    @torch.no_grad()
    def _rewards(
        self,
        observation: Tensor,
        next_observation: Tensor,
        tensordict: TensorDictBase,
        next_tensordict: TensorDictBase,
    ) -> tuple[Tensor]:
        bonus = self._bonus(observation, next_observation, tensordict)
        bonus = self._scaled(bonus, self.deviation)
        if self.extrinsic_weight:
            reward = self._read(next_tensordict, self.reward_key, "next").to(bonus)
            bonus = bonus + self.extrinsic_weight * self._scaled(reward, self.reward_deviation)
        return (bonus,)

    def _scaled(self, values: Tensor, deviation: RunningDeviation | None) -> Tensor:
        if deviation is None:
            return values
        if deviation.mean.device != values.device:
            deviation.to(values.device)
        if self.update_statistics:
            deviation.update(values)
        return values / deviation.divisor
