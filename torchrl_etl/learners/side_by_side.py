"""Several learners, one a seed, whose gradients are computed together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_etl.draws import given_draws
from torchrl_etl.learners.compiled import compiled, cuda_graph
from torchrl_etl.learners.sac import SACLearner

__all__ = ["SideBySide"]


class SideBySide:
    """Updates learners of one make as each would be by itself, with one pass through the networks.

    The objective is that of the first learner, under :func:`torch.vmap` over the stacked parameters
    and buffers of all: there is no second set of equations. Optimizers, targets and EMAs stay those
    of the learners; the pass is compiled if theirs are.

    Args:
        learners (sequence of SACLearner): of equal sizes, bounds and settings; weights, statistics
            and whatever else their modules hold as buffers may differ.

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
        >>> group = SideBySide([learner(), learner()])
        >>> draws = [each.draw(batch) for each, batch in zip(group.learners, batches)]
        >>> logs = group.update(batches, draws)
        >>> [log["loss_qvalue"].shape for log in logs]
        [torch.Size([]), torch.Size([])]
    """

    def __init__(self, learners: Sequence[SACLearner]) -> None:
        if not learners:
            raise ValueError("learners is empty; give at least one.")
        shapes = [[parameter.shape for parameter in of.parameters] for of in learners]
        if other := next((i for i, found in enumerate(shapes) if found != shapes[0]), None):
            raise ValueError(
                f"learners[{other}] has parameters of other shapes than learners[0]; learners are "
                "updated side by side only where observations, actions and networks agree."
            )
        self.learners = list(learners)
        first = learners[0]
        self._gradients = compiled(self.gradients) if first.compile else self.gradients
        graphed = first.compile and first.device.type == "cuda"
        self._step = cuda_graph(self.step) if graphed else self.step

    def update(
        self, batches: Sequence[TensorDictBase], draws: Sequence[Sequence[Tensor]]
    ) -> list[TensorDictBase]:
        """One update of every learner, each on its own batch [B] and with its own random numbers.

        Returns:
            list of TensorDictBase: the scalars of each.
        """
        one = self.updates([batch.unsqueeze(0) for batch in batches], [[each] for each in draws])
        return [scalars[0] for scalars in one]

    def updates(
        self, batches: Sequence[TensorDictBase], draws: Sequence[Sequence[Sequence[Tensor]]]
    ) -> list[TensorDictBase]:
        """Updates of every learner on its batches [k, B], as many for each, one after the other.

        Returns:
            list of TensorDictBase: the scalars [k] of each.
        """
        scalars = []
        for inputs in stacked(batches, draws):
            scalars.append(self._step(inputs))
            for learner in self.learners:
                learner.ema.follow()
        return list(torch.stack(scalars).unbind(1))

    def step(self, inputs: TensorDictBase) -> TensorDictBase:
        """Everything of an update that runs on the device; returns scalars [seeds]."""
        gradients, scalars = self._gradients(inputs)
        for learner, own in zip(self.learners, gradients, strict=True):
            learner.descend(own)
        return scalars

    def gradients(
        self, inputs: TensorDictBase
    ) -> tuple[list[tuple[Tensor | None, ...]], TensorDictBase]:
        """Each learner's gradients in the order of its ``parameters``, and scalars [seeds].

        Args:
            inputs (TensorDictBase): of shape [seeds]: ``batch`` [seeds, B], and under ``draws`` the
                random numbers in the order in which they are drawn.
        """
        objectives = [learner.objective for learner in self.learners]
        # Stacked anew each time: gradients then flow back to the learners' own parameters.
        params = torch.stack([TensorDict.from_module(each) for each in objectives])
        first, draws = objectives[0], inputs["draws"]
        order = [draws[f"{i}"] for i in range(len(draws.keys()))]

        def objective(
            params: TensorDictBase, batch: TensorDictBase, given: Any
        ) -> tuple[Tensor, TensorDictBase]:
            with params.to_module(first, preserve_module_state=False), given_draws(given):
                return first(batch)

        losses, scalars = torch.vmap(objective)(params, inputs["batch"], order)
        parameters = [p for learner in self.learners for p in learner.parameters]
        flat = torch.autograd.grad(losses.sum(), parameters, allow_unused=True)
        count = len(self.learners[0].parameters)
        return [flat[i : i + count] for i in range(0, len(flat), count)], scalars.detach()


def stacked(
    batches: Sequence[TensorDictBase], draws: Sequence[Sequence[Sequence[Tensor]]]
) -> TensorDictBase:
    """What :meth:`SideBySide.gradients` takes for one update after the other, [k, seeds].

    Args:
        batches (sequence of TensorDictBase): those [k, B] of each learner.
        draws (sequence): the random numbers of each, in the order in which an update draws them,
            for each of the k updates.
    """
    size = [len(draws[0]), len(draws)]
    in_turn = [own for turn in zip(*draws, strict=True) for own in turn]
    numbers = [torch.stack(each).unflatten(0, size) for each in zip(*in_turn, strict=True)]
    given = {f"{i}": each for i, each in enumerate(numbers)}
    batch = torch.stack(list(batches), 1)
    return TensorDict({"batch": batch, "draws": TensorDict(given, size)}, size)
