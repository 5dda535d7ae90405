"""Exploration noise that lasts."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_etl.checks import check_positive, check_real

__all__ = ["HeldNoise"]


class HeldNoise(TensorDictModuleBase):
    """An actor whose noise is held for several steps: it moves a body where white noise shakes it.

    The action is that of the actor's own distribution, its standard normal variable drawn once
    and kept for k steps, with P(k) ∝ k^-exponent, k ≤ longest (FlashSAC, 2026). Each step's action
    is distributed as before; only the correlation over time is new, and off-policy learners need
    not know of it.

    The noise is this module's own, by row of the batch: it must be called with the same simulators
    in the same order, as a collector does. Under any other exploration type than random it is the
    actor itself.

    Args:
        actor (ProbabilisticTensorDictSequential): with a ``TanhNormal``, as of
            :func:`~torchrl_etl.modules.make_actor`.

    Keyword Args:
        exponent (float): above 0; the larger, the shorter. Default: 2.
        longest (int): most steps. Default: 16.
        init_key (NestedKey): see :class:`torchrl.envs.InitTracker`. Default: ``"is_init"``.

    Keys:
        reads the actor's, and ``is_init`` [*, 1], where noise is drawn anew; writes the actor's.

    Raises:
        ValueError: if exponent or longest are not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.modules import HeldNoise, make_actor
        >>> policy = HeldNoise(make_actor({"observation": 3}, Bounded(-1, 1, shape=(2,))))
        >>> entries = {"observation": torch.zeros(4, 3), "is_init": torch.ones(4, 1).bool()}
        >>> policy(TensorDict(entries, [4]))["action"].shape
        torch.Size([4, 2])
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        *,
        exponent: float = 2.0,
        longest: int = 16,
        init_key: NestedKey = "is_init",
    ) -> None:
        check_real("(0, inf)", exponent=exponent)
        check_positive(longest=longest)
        super().__init__()
        self.actor, self.init_key = actor, init_key
        self.in_keys = [*actor.in_keys, init_key]
        self.out_keys = list(actor.out_keys)
        self._chances = torch.arange(1, longest + 1, dtype=torch.float64).pow(-exponent)
        self._noise: Tensor | None = None
        self._left: Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if exploration_type() not in (None, ExplorationType.RANDOM):
            return self.actor(tensordict)
        distribution = self.actor.get_dist(tensordict)
        noise = self._drawn(distribution.loc, tensordict.get(self.init_key).squeeze(-1))
        action = distribution.loc + distribution.scale * noise
        for transform in distribution.transforms:
            action = transform(action)
        return tensordict.set(self.actor.dist_sample_keys[0], action)

    def _drawn(self, like: Tensor, begins: Tensor) -> Tensor:
        """The noise [*, n] of this step."""
        if self._noise is None or self._noise.shape != like.shape:
            self._noise = torch.zeros_like(like)
            self._left = torch.zeros_like(begins, dtype=torch.long)
        # All rows are drawn every time, so that random numbers do not depend on what is used.
        lengths = 1 + torch.multinomial(self._chances, begins.numel(), replacement=True)
        fresh = begins | (self._left == 0)
        drawn = torch.randn_like(like)
        self._left = torch.where(fresh, lengths.to(begins.device).view_as(begins), self._left) - 1
        self._noise = torch.where(fresh.unsqueeze(-1), drawn, self._noise)
        return self._noise
