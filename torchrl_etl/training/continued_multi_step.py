"""Targets of several steps that do not end with a collector's batch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torchrl.data.postprocs import MultiStep

__all__ = ["ContinuedMultiStep"]


class ContinuedMultiStep(MultiStep):
    """TorchRL's ``MultiStep`` that waits for the next batch where this one ends too early.

    Each transition is made to span ``n_steps`` steps, or those to the end of its episode: its
    reward is their discounted sum, and what follows it, flags included, is what follows the last
    of them. The last ``n_steps - 1`` of a batch come out with the next batch, if that one goes on
    where this one ended; otherwise (it is another worker's, say) they come out with fewer steps.

    :class:`~torchrl.envs.MultiStepTransform` waits too, but takes it for granted that batches go
    on from each other.

    Args:
        gamma (float): discount factor.
        n_steps (int): most steps of a transition.

    Keys:
        those of :class:`torchrl.data.postprocs.MultiStep`; the input is a batch [simulators, time]
        with ``observation``, the output is flat.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.training.continued_multi_step import ContinuedMultiStep
        >>> def batch(first):
        ...     steps = torch.arange(first, first + 2.0).view(1, 2, 1)
        ...     ends = torch.zeros(1, 2, 1, dtype=torch.bool)
        ...     following = {"observation": steps + 1, "reward": steps, "done": ends}
        ...     return TensorDict({"observation": steps, "next": following}, [1, 2])
        >>> span = ContinuedMultiStep(gamma=0.5, n_steps=2)
        >>> span(batch(0))["next", "reward"].flatten()  # 0 + 1 / 2; what 1 leads to is not known
        tensor([0.5000])
        >>> span(batch(2))["next", "reward"].flatten()  # 1 + 2 / 2 and 2 + 3 / 2
        tensor([2.0000, 3.5000])
    """

    def __init__(self, gamma: float, n_steps: int) -> None:
        super().__init__(gamma, n_steps)
        # TorchRL 0.14.1 leaves these at the first step, and bootstraps past an end.
        self.done_keys = ()
        self._waiting: TensorDictBase | None = None

    def forget(self) -> None:
        """What waits is dropped: episodes begin anew."""
        self._waiting = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        cut: Sequence[TensorDictBase] = ()
        if self._waiting is not None:
            if _goes_on(self._waiting, tensordict):
                tensordict = torch.cat([self._waiting, tensordict], 1)
            else:
                cut = super().forward(self._waiting).unbind(0)
        held = min(self.n_steps - 1, tensordict.shape[1])
        known = tensordict.shape[1] - held
        self._waiting = tensordict[:, known:].clone()
        spans = super().forward(tensordict)[:, :known]
        return torch.cat([*cut, *spans.unbind(0)])


def _goes_on(before: TensorDictBase, batch: TensorDictBase) -> bool:
    """Whether a batch begins with what every simulator saw last, or after the end of an episode."""
    if len(before) != len(batch):
        return False
    seen, sees = before[:, -1]["next"], batch["observation"][:, 0]
    return bool((seen["done"].squeeze(-1) | (seen["observation"] == sees).all(-1)).all())
