"""Several learners, one a seed, whose gradients are computed together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_etl.learners.compiled import compiled
from torchrl_etl.learners.sac import SACLearner

__all__ = ["SideBySide"]


class SideBySide:
    """Updates learners of one make as each would be by itself, with one pass through the networks.

    The objective is that of the first learner, under :func:`torch.vmap` over the stacked parameters
    and buffers of all: there is no second set of equations. Optimizers, targets and EMAs stay those
    of the learners.

    Args:
        learners (sequence of SACLearner): of equal sizes and settings; their bounds, statistics and
            weights may differ.

    Keyword Args:
        compile (bool): compile the pass. Default: ``False``.

    Raises:
        ValueError: if there is no learner, or one has parameters of other shapes.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.learners import SACLearner, SideBySide
        >>> from torchrl_etl.modules import make_actor, make_critic
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> def learner():
        ...     critic = make_critic({"observation": 3, "action": 2})
        ...     return SACLearner(make_actor({"observation": 3}, spec), critic, action_spec=spec)
        >>> flag = torch.zeros(4, 1, dtype=torch.bool)
        >>> ends = {"reward": torch.zeros(4, 1), "done": flag, "terminated": flag}
        >>> entries = {"observation": torch.randn(4, 3), "action": torch.zeros(4, 2)}
        >>> entries["next"] = {"observation": torch.randn(4, 3), **ends}
        >>> batches = [TensorDict(entries, [4]) for _ in range(2)]
        >>> logs = SideBySide([learner(), learner()]).update(batches)
        >>> [log["loss_qvalue"].shape for log in logs]
        [torch.Size([]), torch.Size([])]
    """

    def __init__(self, learners: Sequence[SACLearner], *, compile: bool = False) -> None:
        if not learners:
            raise ValueError("learners is empty; give at least one.")
        shapes = [[parameter.shape for parameter in of.parameters] for of in learners]
        if other := next((i for i, found in enumerate(shapes) if found != shapes[0]), None):
            raise ValueError(
                f"learners[{other}] has parameters of other shapes than learners[0]; learners are "
                "updated side by side only where observations, actions and networks agree."
            )
        self.learners = list(learners)
        self._gradients = compiled(self.gradients) if compile else self.gradients

    def update(self, batches: Sequence[TensorDictBase]) -> list[TensorDictBase]:
        """One update of every learner, each on its own batch [B]; returns their scalars."""
        gradients, scalars = self._gradients(torch.stack(list(batches)))
        for learner, own in zip(self.learners, gradients, strict=True):
            learner.descend(own)
            learner.ema.update_parameters(learner.actor)
        return list(scalars.unbind(0))

    def gradients(
        self, batches: TensorDictBase
    ) -> tuple[list[tuple[Tensor | None, ...]], TensorDictBase]:
        """Each learner's gradients in the order of its ``parameters``, and scalars [seeds].

        Args:
            batches (TensorDictBase): of shape [seeds, B].
        """
        objectives = [learner.objective for learner in self.learners]
        # Stacked anew each time: gradients then flow back to the learners' own parameters.
        stacked = torch.stack([TensorDict.from_module(each) for each in objectives])
        first = objectives[0]

        def objective(params: TensorDictBase, batch: TensorDictBase) -> tuple[Tensor, Any]:
            with params.to_module(first):
                return first(batch)

        losses, scalars = torch.vmap(objective, (0, 0), randomness="different")(stacked, batches)
        parameters = [p for learner in self.learners for p in learner.parameters]
        flat = torch.autograd.grad(losses.sum(), parameters, allow_unused=True)
        count = len(self.learners[0].parameters)
        return [flat[i : i + count] for i in range(0, len(flat), count)], scalars.detach()
