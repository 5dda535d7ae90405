"""An ensemble of reward predictors and EME's measure of their disagreement."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_etl.checks import check_integer

__all__ = ["RewardEnsemble", "diversity_scale"]


def diversity_scale(predictions: Tensor, maximum: float = 10.0) -> Tensor:
    r"""EME's factor ``[*, 1]``: variance of reward predictions ``[*, K]``, clamped to ``[1, M]``.

    .. math:: \min(\max(\mathrm{Var}_k\, \hat r_k(s, a),\, 1),\, M)

    Deviates: the paper does not say which variance; this is the population's (divided by K).

    Examples:
        >>> import torch
        >>> from torchrl_etl.baselines.reward_ensemble import diversity_scale
        >>> diversity_scale(torch.tensor([[0.0, 1.0], [0.0, 4.0], [0.0, 10.0]])).flatten()
        tensor([ 1.,  4., 10.])
    """
    return predictions.var(-1, correction=0, keepdim=True).clamp(1.0, maximum)


class _Members(nn.ModuleList):
    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        inputs = torch.cat([observation, action], -1)
        return torch.cat([member(inputs) for member in self], -1)


class RewardEnsemble(TensorDictModule):
    """Reward predictors r̂_k(s, a), each with its own initialization.

    Args:
        observation_dim (int): size O of the observation.
        action_dim (int): number n of actuators.
        size (int): number K of members. With one, the variance is zero and EME's scale always 1.
            Default: ``6``.

    Keyword Args:
        hidden (sequence of int): widths of the hidden layers. Default: ``(256, 256)``.
        in_keys (sequence of NestedKey): observation and action, in this order.
        out_keys (sequence of NestedKey): the predictions.

    Keys:
        reads ``observation`` [*, O] and ``action`` [*, n]; writes ``reward_prediction`` [*, K] in
        units of the reward.

    Raises:
        ValueError: if a size is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.baselines.reward_ensemble import RewardEnsemble
        >>> ensemble = RewardEnsemble(observation_dim=7, action_dim=5)
        >>> data = TensorDict({"observation": torch.randn(3, 7), "action": torch.randn(3, 5)}, [3])
        >>> ensemble(data)["reward_prediction"].shape
        torch.Size([3, 6])
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        size: int = 6,
        *,
        hidden: Sequence[int] = (256, 256),
        in_keys: Sequence[NestedKey] = ("observation", "action"),
        out_keys: Sequence[NestedKey] = ("reward_prediction",),
    ) -> None:
        check_integer(1, observation_dim=observation_dim, action_dim=action_dim, size=size)
        members = _Members(
            MLP(observation_dim + action_dim, 1, num_cells=list(hidden), activation_class=nn.ReLU)
            for _ in range(size)
        )
        super().__init__(members, in_keys=list(in_keys), out_keys=list(out_keys))
