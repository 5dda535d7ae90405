"""Several learners, one a seed, each in a thread of its own."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_etl.learners.sac import SACLearner

__all__ = ["InThreads"]


class InThreads:
    """Updates learners at the same time, as each would be by itself.

    For updates that are compiled for a CPU: PyTorch's operations run beside each other, what Python
    does between them takes turns. Threads of PyTorch's own are divided among the learners.

    Args:
        learners (sequence of SACLearner): of any make.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.learners import InThreads, SACLearner
        >>> from torchrl_etl.modules import make_actor, make_critic
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> def learner():
        ...     critic = make_critic({"observation": 3, "action": 2})
        ...     return SACLearner(make_actor({"observation": 3}, spec), critic, action_spec=spec)
        >>> flag = torch.zeros(4, 1, dtype=torch.bool)
        >>> ends = {"reward": torch.zeros(4, 1), "done": flag, "terminated": flag}
        >>> entries = {"observation": torch.randn(4, 3), "action": torch.zeros(4, 2)}
        >>> entries["next"] = {"observation": torch.randn(4, 3), **ends}
        >>> earned = TensorDict(entries, [4]).expand(16, 4)  # 16 updates
        >>> group = InThreads([learner(), learner()])
        >>> draws = [[each.draw(batch) for batch in earned] for each in group.learners]
        >>> [log["loss_qvalue"].shape for log in group.updates([earned, earned], draws)]
        [torch.Size([16]), torch.Size([16])]
    """

    def __init__(self, learners: Sequence[SACLearner]) -> None:
        self.learners = list(learners)
        share = max(1, torch.get_num_threads() // len(self.learners))
        self._pool = ThreadPoolExecutor(
            len(self.learners), initializer=torch.set_num_threads, initargs=(share,)
        )

    def updates(
        self, batches: Sequence[TensorDictBase], draws: Sequence[Sequence[Sequence[Tensor]]]
    ) -> list[TensorDictBase]:
        """Updates of every learner on its batches [k, B], one after the other.

        Returns:
            list of TensorDictBase: the scalars [k] of each.
        """
        return list(self._pool.map(SACLearner.updates, self.learners, batches, draws))
