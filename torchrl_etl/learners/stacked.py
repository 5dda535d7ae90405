"""Several learners, one per seed, whose gradients are computed together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_etl.draws import drawn_in
from torchrl_etl.learners.objective import Objective
from torchrl_etl.learners.sac import Gradients, SACLearner

__all__ = ["StackedLearners"]


class StackedLearners:
    """Updates learners of equal architecture in one pass, as if each were updated alone.

    It runs the objective of the first learner under :func:`torch.vmap` over the stacked tensors of
    all learners. The first learner's optimizer, targets and EMA then update the stacks, so no
    equation is implemented twice. Tensors are copied from the learners before updates and back
    afterwards. The pass is compiled if the learners' updates are.

    Args:
        learners (sequence of SACLearner): of equal networks, settings (``blueprint``) and update
            counts; only parameters and buffers may differ.

    Raises:
        ValueError: if there is no learner, or if blueprints differ; at an update, if update
            counts, learning rates, tau or EMA decay differ; at the first update, if a transform
            reads a network that is neither its submodule nor among its ``networks``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.learners import SACLearner, StackedLearners
        >>> from torchrl_etl.modules import make_actor, make_critic
        >>> from torchrl_etl.objectives import make_sac_loss
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> def learner():
        ...     actor = make_actor({"observation": 3}, spec)
        ...     critic = make_critic({"observation": 3, "action": 2})
        ...     return SACLearner(actor, make_sac_loss(actor, critic, action_spec=spec))
        >>> flag = torch.zeros(5, 4, 1, dtype=torch.bool)
        >>> ends = {"reward": torch.zeros(5, 4, 1), "done": flag, "terminated": flag}
        >>> entries = {"observation": torch.randn(5, 4, 3), "action": torch.zeros(5, 4, 2)}
        >>> entries["next"] = {"observation": torch.randn(5, 4, 3), **ends}
        >>> batches = TensorDict(entries, [5, 4])  # for five updates
        >>> group = StackedLearners([learner(), learner()])
        >>> logs = group.updates([each.inputs(batches) for each in group.learners])
        >>> [log["loss_qvalue"].shape for log in logs]
        [torch.Size([5]), torch.Size([5])]
    """

    def __init__(self, learners: Sequence[SACLearner]) -> None:
        if not learners:
            raise ValueError("learners is empty; pass at least one.")
        if len({learner.blueprint for learner in learners}) > 1:
            raise ValueError(
                "The learners differ in more than parameters and buffers; learners that are "
                "updated side by side need the same networks and settings."
            )
        self.learners = list(learners)
        self._stacks: dict[int, Tensor] = {}
        self._whole = whole(learners[0].objective)
        self._checked = not learners[0].objective.transforms
        self._stacked = learners[0].mapped(self._stack, self.gradients)

    def updates(self, inputs: Sequence[TensorDictBase]) -> list[TensorDictBase]:
        """Run k updates of every learner on its own :meth:`SACLearner.inputs` [k]; returns the
        scalars [k] of each."""
        self._load()
        of_all = torch.stack(list(inputs), 1)
        if not self._checked:
            self._check(of_all[0])
            self._checked = True
        scalars = self._stacked.updates(of_all)
        self._store()
        return list(scalars.unbind(1))

    def gradients(self, inputs: TensorDictBase) -> Gradients:
        """Stacked :meth:`SACLearner.gradients` of all learners [seeds, ...].

        Args:
            inputs (TensorDictBase): stacked :meth:`SACLearner.inputs` of all learners [seeds].
        """
        first = self.learners[0]

        def loss(tensors: TensorDictBase, own: TensorDictBase) -> tuple[Any, ...]:
            with tensors.to_module(self._whole, preserve_module_state=False):
                return first.loss(own["batch"], own["draws"])

        losses, scalars, statistics = torch.vmap(loss)(self._tensors(), inputs)
        gradients = torch.autograd.grad(losses.sum(), self._stacked.parameters, allow_unused=True)
        return gradients, scalars.detach(), statistics

    @torch.no_grad()
    def _check(self, inputs: TensorDictBase) -> None:
        """Raise if a transform evaluates the first learner's networks for every learner."""
        first = self.learners[0].objective

        def reward(objective: Objective, own: TensorDictBase) -> Tensor:
            with drawn_in(own["draws"]):
                return objective.prepare(own["batch"])["next", objective.reward]

        def of_the_first(tensors: TensorDictBase, own: TensorDictBase) -> Tensor:
            with tensors.to_module(self._whole, preserve_module_state=False):
                return reward(first, own)

        with _as_it_was(self._stacked):
            together = torch.vmap(of_the_first)(self._tensors(), inputs)
        for each, own, found in zip(self.learners, inputs, together, strict=True):
            with _as_it_was(each):
                alone = reward(each.objective, own)
            rounding = 0.02 * alone.std() + 1e-3 * alone.abs().max()
            if (found - alone).abs().max() > rounding:
                names = ", ".join(type(transform).__name__ for transform in first.transforms)
                raise ValueError(
                    f"{names} gives a different {first.reward} with several seeds than with one, "
                    "so it reads modules that are not known to belong to it; list them in its "
                    "attribute networks, a tuple."
                )

    def _tensors(self) -> TensorDictBase:
        """Tensors that the learners' objectives hold or read [seeds]: the stacks, and constant
        tensors stacked on the fly."""

        def stack(*own: Tensor) -> Tensor:
            found = self._stacks.get(id(own[0]))
            return torch.stack(own) if found is None else found

        first, *others = (TensorDict.from_module(whole(each.objective)) for each in self.learners)
        return first.apply(stack, *others, batch_size=[len(self.learners)])

    def _stack(self, own: Tensor) -> Tensor:
        """The stack in which a tensor of the first learner and its counterparts are updated."""
        if id(own) not in self._stacks:
            stack = own.new_empty(len(self.learners), *own.shape)
            self._stacks[id(own)] = nn.Parameter(stack) if own.requires_grad else stack
        return self._stacks[id(own)]

    @torch.no_grad()
    def _load(self) -> None:
        """Copy the learners' tensors, update counts and rates into the stacks."""
        if len(differing := {learner.step_sizes for learner in self.learners}) > 1:
            raise ValueError(
                "The learners' updates and rates differ "
                f"({'; '.join(map(str, sorted(differing)))}); learners that are updated side by "
                "side need as many updates and the same settings."
            )
        first, stacked = self.learners[0].optimizer, self._stacked.optimizer
        torch._foreach_copy_(*self._rows_and_own())
        torch._foreach_copy_(stacked.steps, first.steps)
        for group, own in zip(stacked.param_groups, first.param_groups, strict=True):
            group["lr"] = own["lr"]

    @torch.no_grad()
    def _store(self) -> None:
        """Copy the stacks' tensors and update counts back into the learners."""
        rows, own = self._rows_and_own()
        torch._foreach_copy_(own, rows)
        for learner in self.learners:
            torch._foreach_copy_(learner.optimizer.steps, self._stacked.optimizer.steps)
            learner.ema.n_averaged.copy_(self._stacked.ema.n_averaged)

    def _rows_and_own(self) -> tuple[list[Tensor], list[Tensor]]:
        """Rows of the stacks, learner by learner, and the learners' own tensors."""
        rows = zip(*(stack.unbind(0) for stack in self._stacked.state), strict=True)
        own = (learner.state for learner in self.learners)
        return [row for each in rows for row in each], [tensor for each in own for tensor in each]


def whole(objective: Objective) -> nn.Module:
    """An objective with the networks that its transforms read."""
    return nn.ModuleList([objective, *objective.networks])


@contextmanager
def _as_it_was(learner: SACLearner) -> Iterator[None]:
    """Restore the statistics of the learner's transforms on exit."""
    before = [each.clone() for each in learner.statistics.values()]
    try:
        yield
    finally:
        for each, kept in zip(learner.statistics.values(), before, strict=True):
            each.copy_(kept)
