"""n-step targets that continue across collector batches."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torchrl.data.postprocs import MultiStep

__all__ = ["ContinuedMultiStep"]


class ContinuedMultiStep(MultiStep):
    """TorchRL's ``MultiStep``, except that incomplete transitions wait for the next batch.

    Each transition spans ``n_steps`` steps, or fewer at the end of its episode. Its reward is their
    discounted sum, and its next observation and flags are those of the last step. The last
    ``n_steps - 1`` transitions of a batch are returned with the next batch if that continues this
    one. Otherwise (if it comes from another worker, for example) they get fewer steps.

    :class:`~torchrl.envs.MultiStepTransform` waits too, but assumes that each batch continues the
    one before.

    Args:
        gamma (float): discount factor.
        n_steps (int): maximum number of steps of a transition.

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
        # TorchRL 0.14.1 takes these from the first step and so bootstraps past an end.
        self.done_keys = ()
        self._waiting: TensorDictBase | None = None

    def forget(self) -> None:
        """Drop waiting transitions, as episodes restart."""
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
    """Whether every simulator continues the batch before, or starts a new episode."""
    if len(before) != len(batch):
        return False
    seen, sees = before[:, -1]["next"], batch["observation"][:, 0]
    return bool((seen["done"].squeeze(-1) | (seen["observation"] == sees).all(-1)).all())
