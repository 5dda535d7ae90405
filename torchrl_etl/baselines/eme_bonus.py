"""EME's bonus (Wang 2024): how far a step moved in the learned metric."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from torchrl_etl import functional
from torchrl_etl.baselines.reward_ensemble import diversity_scale
from torchrl_etl.checks import check_flag, check_real
from torchrl_etl.modules.running_deviation import RunningDeviation
from torchrl_etl.transforms.keys import check_network
from torchrl_etl.transforms.transition_reward import TransitionReward, evaluate

__all__ = ["EMEBonus"]


class EMEBonus(TransitionReward):
    """Rewards steps that are long in EME's metric, more so where reward predictions disagree.

    Like :class:`~torchrl_etl.transforms.IntrinsicReward` it works on an env, a tensordict, a replay
    buffer or in a learner; the last two give every *sampled* batch the current networks' bonus.
    Both networks are held by reference; :class:`~torchrl_etl.baselines.eme.EMELoss` trains them.

    Equation: ``b = d(s, s') min(max(Var_k r̂_k(s, a), 1), M)``, and ``r + weight b`` for the
    learner; with ``normalize``, ``r + weight σ_r b / σ_b`` with running standard deviations.

    Deviates: the public code adds four terms (cosine distance, KL, error of the reward, capped
    variance) where the paper has this product. ``normalize`` is in neither.

    Args:
        encoder (TensorDictModuleBase): φ, with one in-key and one out-key; d is the L2 distance of
            its embeddings. Its key names may differ from the data's.
        ensemble (TensorDictModuleBase): reward predictors, with two in-keys (observation and
            action, in this order) and one out-key, with one prediction per member [*, K]. Likewise.

    Keyword Args:
        weight (float): weight of the bonus in the total reward. Default: 1.
        max_scale (float): M, at least 1. Default: 10.
        normalize (bool): scale the bonus to ``weight`` times the deviation of the task's reward.
            Unscaled, it grows without bound as the policy becomes certain, since KL and with it
            the metric do. As long as all rewards were zero, their deviation counts as 1.
            Default: ``False``.
        decay (float): in (0, 1); a call has weight ``1 - decay`` in the running statistics, which
            are in the ``state_dict()``. Default: 0.99.
        in_keys (sequence of NestedKey): keys of observation and action. Default:
            ``("observation", "action")``.
        out_keys (sequence of NestedKey): keys of bonus and total reward, both below ``"next"``.
            Default: ``("intrinsic_reward", "total_reward")``.
        reward_key (NestedKey): the task's reward, not modified. Default: ``"reward"``.

    Keys:
        reads ``observation`` [*, O], ``action`` [*, n], ``("next", "observation")`` and
        ``("next", "reward")`` [*, 1]; writes ``("next", "intrinsic_reward")`` [*, 1], not negative,
        in units of the reward, and ``("next", "total_reward")`` [*, 1].

    Raises:
        TypeError: if a network has no in- and out-keys.
        ValueError: if a network has too many or too few of them, ``in_keys`` or ``out_keys`` is
            not a pair, ``max_scale`` is below 1, ``weight`` is negative, or ``normalize`` is
            neither true nor false.
        KeyError: if an input is in neither the tensordict nor the specs of the env.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.baselines import EMEBonus, RewardEnsemble
        >>> from torchrl_etl.modules import StateEncoder
        >>> bonus = EMEBonus(StateEncoder(3, 2), RewardEnsemble(3, 1), weight=0.1)
        >>> data = TensorDict({"observation": torch.randn(8, 3), "action": torch.randn(8, 1)}, [8])
        >>> data["next"] = {"observation": torch.randn(8, 3), "reward": torch.zeros(8, 1)}
        >>> bool((bonus(data)["next", "total_reward"] > 0).all())
        True
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> rollout = TransformedEnv(GymEnv("Pendulum-v1"), bonus).rollout(5)
        >>> rollout["next", "intrinsic_reward"].shape
        torch.Size([5, 1])
    """

    encoder: TensorDictModuleBase
    ensemble: TensorDictModuleBase
    """The networks given at construction, not copies."""

    _remedy = "name the right one in in_keys."

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        ensemble: TensorDictModuleBase,
        *,
        weight: float = 1.0,
        max_scale: float = 10.0,
        normalize: bool = False,
        decay: float = 0.99,
        in_keys: Sequence[NestedKey] = ("observation", "action"),
        out_keys: Sequence[NestedKey] = ("intrinsic_reward", "total_reward"),
        reward_key: NestedKey = "reward",
    ) -> None:
        check_network("encoder", encoder, ["observation"], "one embedding")
        check_network("ensemble", ensemble, ["observation", "action"], "predictions")
        for name, keys, content in (
            ("in_keys", in_keys, "the observation and the action"),
            ("out_keys", out_keys, "the bonus and the total reward"),
        ):
            if isinstance(keys, str) or len(keys) != 2:
                raise ValueError(f"{name} is {keys!r}; pass a pair of keys, {content}.")
        check_real("[1, inf)", max_scale=max_scale)
        check_real("[0, inf)", weight=weight)
        check_flag(normalize=normalize)
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        # Not submodules: they would follow the env's device, be put in eval mode while the learner
        # uses them, and be saved twice.
        self.__dict__ |= {"encoder": encoder, "ensemble": ensemble}
        self.weight, self.max_scale = weight, max_scale
        self.deviation = RunningDeviation(decay) if normalize else None
        self.reward_deviation = RunningDeviation(decay) if normalize else None
        self.reward_key = unravel_key(reward_key)

    @property
    def networks(self) -> Sequence[nn.Module]:
        return self.encoder, self.ensemble

    @property
    def _typed_by(self) -> NestedKey:
        return self.reward_key

    @torch.no_grad()
    def _rewards(
        self,
        observation: Tensor,
        next_observation: Tensor,
        tensordict: TensorDictBase,
        next_tensordict: TensorDictBase,
    ) -> tuple[Tensor, Tensor]:
        action = self._read(tensordict, self.in_keys[1])
        reward = self._read(next_tensordict, self.reward_key, "next")
        # One pass through the encoder for both ends of the transition.
        ends = evaluate(self.encoder, torch.stack([observation, next_observation]))
        distance = functional.l2_distance(*ends.unbind(0)).unsqueeze(-1)
        scale = diversity_scale(evaluate(self.ensemble, observation, action), self.max_scale)
        bonus = distance.to(reward) * scale.to(reward)
        return bonus, reward + self.weight * self._in_units_of(reward, bonus)

    def _in_units_of(self, reward: Tensor, bonus: Tensor) -> Tensor:
        """The bonus; if normalized, with the deviation of the rewards."""
        if self.deviation is None or self.reward_deviation is None:
            return bonus
        self.deviation.update(bonus)
        self.reward_deviation.update(reward)
        rewarded = self.reward_deviation.mean.square() + self.reward_deviation.variance > 0
        unit = torch.where(rewarded, self.reward_deviation.divisor, 1.0)
        return unit * bonus / self.deviation.divisor
