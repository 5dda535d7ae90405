"""Uniform actions at the beginning of a run."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_etl.checks import check_integer
from torchrl_etl.modules.recorded_actions import bounds_of
from torchrl_etl.modules.scheduled import Scheduled

__all__ = ["UniformWarmup"]


class UniformWarmup(TensorDictModuleBase, Scheduled):
    """Replaces a policy's first ``actions`` actions by uniform ones.

    Put it after the actor: ``TensorDictSequential(actor, UniformWarmup(action_spec, 10_000))``.
    ``init_random_frames`` of TorchRL's collectors draws *environment* actions and restarts when a
    run is resumed. This draws from the *actor's* space (synergies too), and its count can be set.
    The count is in neither the tensordict nor the ``state_dict()``, so new weights leave a worker's
    count alone. Unless exploration is set to random, actions pass unchanged and uncounted.

    Args:
        action_spec (Bounded): the actor's output, unbatched.
        actions (int): number of actions to replace, of all rows together.

    Keyword Args:
        action_key (NestedKey): Default: ``"action"``.

    Keys:
        reads and writes ``action`` [*, n], within the bounds of the spec.

    Raises:
        ValueError: if actions is negative, or the spec has no finite bounds.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.envs import ExplorationType, set_exploration_type
        >>> from torchrl_etl.modules import UniformWarmup
        >>> warmup = UniformWarmup(Bounded(0, 1, shape=(2,)), actions=3)
        >>> data = TensorDict({"action": torch.full((3, 2), 7.0)}, [3])
        >>> with set_exploration_type(ExplorationType.RANDOM):
        ...     first, second = warmup(data.clone())["action"], warmup(data.clone())["action"]
        >>> bool((first <= 1).all()), bool((second == 7).all())
        (True, True)
    """

    seen: int
    """Actions counted so far; :meth:`restart` sets it."""

    def __init__(
        self, action_spec: Bounded, actions: int, *, action_key: NestedKey = "action"
    ) -> None:
        check_integer(0, actions=actions)
        low, high = bounds_of(action_spec)
        super().__init__()
        self.actions, self.seen = actions, 0
        self.action_key = unravel_key(action_key)
        self.in_keys = self.out_keys = [self.action_key]
        self.register_buffer("low", low.clone(), persistent=False)
        self.register_buffer("high", high.clone(), persistent=False)

    def restart(self, actions: int) -> None:
        self.seen = actions

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if exploration_type() is not ExplorationType.RANDOM or self.seen >= self.actions:
            return tensordict
        action = tensordict.get(self.action_key)
        self.seen += action.shape[:-1].numel()
        uniform = self.low + torch.rand_like(action) * (self.high - self.low)
        return tensordict.set(self.action_key, uniform.to(action))
