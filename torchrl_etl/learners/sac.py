"""Soft actor-critic: the state of a learner and its update."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.envs.transforms import Transform

from torchrl_etl.checks import check_real
from torchrl_etl.draws import drawn_in, redrawn
from torchrl_etl.learners.adam import make_optimizer, parameter_groups
from torchrl_etl.learners.blueprint import blueprint
from torchrl_etl.learners.compiled import compiled, cuda_graph
from torchrl_etl.learners.ema import WarmedUpEMA
from torchrl_etl.learners.objective import Objective
from torchrl_etl.learners.policy import from_observation
from torchrl_etl.learners.term import Term
from torchrl_etl.modules import ReturnScale, RunningNorm, Scheduled, SynergyMap
from torchrl_etl.modules.return_scale import episode_numbers
from torchrl_etl.objectives import FusedSoftUpdate, LeanSACLoss, SynergySACLoss

__all__ = ["Gradients", "SACLearner"]

Gradients: TypeAlias = tuple[tuple[Tensor | None, ...], TensorDictBase, tuple[Tensor, ...]]
"""Gradients in the order of ``parameters``, scalars to log, and new values of ``statistics``."""


class SACLearner:
    """Soft actor-critic that owns its networks, targets, statistics and optimizer.

    Both stages of ETL and all baselines use this class, each with its own components.

    Args:
        actor (ProbabilisticTensorDictSequential): writes an action, or what ``decoder`` reads.
        sac (LeanSACLoss): SAC's losses of this actor, see
            :func:`~torchrl_etl.objectives.make_sac_loss`.

    Keyword Args:
        decoder (SynergyMap, optional): maps the actor's output to actions.
        behavior (TensorDictModuleBase, optional): policy that collects, such as the actor with
            exploration noise. Its :class:`~torchrl_etl.modules.Scheduled` modules are told how far
            the run is. Default: the actor.
        terms (sequence of Term): losses to minimize besides SAC's. Default: none.
        transforms (sequence of Transform): applied to each batch at its update, when they see the
            current networks; an intrinsic bonus, for example. The attribute ``networks`` of a
            transform lists networks that it reads but does not own. Default: none.
        normalizer (RunningNorm, optional): normalizes ``observation`` to
            :data:`~torchrl_etl.learners.NORMALIZED`, which actor and critic must then read.
        return_scale (ReturnScale, optional): scales the reward that SAC learns from.
        reward (NestedKey): reward that SAC learns from, below ``"next"``. Default: ``"reward"``.
        tau (float): EMA rate of the target critics. Default: 0.005.
        lr, lr_end (float): initial learning rate, and the fraction of every learning rate that is
            left at the last frame (linear decay). Default: 3e-4 and 1.
        ema_decay (float): EMA decay of the actor that is evaluated and saved. Default: 0.
        compile (bool): compile updates; on CUDA, also capture each as one CUDA graph.

    Raises:
        ValueError: if a number is out of range, or ``sac`` is a loss of another actor or decoder.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.learners import SACLearner
        >>> from torchrl_etl.modules import make_actor, make_critic
        >>> from torchrl_etl.objectives import make_sac_loss
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> actor = make_actor({"observation": 3}, spec)
        >>> critic = make_critic({"observation": 3, "action": 2})
        >>> learner = SACLearner(actor, make_sac_loss(actor, critic, action_spec=spec))
        >>> end = torch.zeros(8, 1, dtype=torch.bool)
        >>> following = {"observation": torch.randn(8, 3), "reward": torch.zeros(8, 1)}
        >>> following |= {"done": end, "terminated": end}
        >>> entries = {"observation": torch.randn(8, 3), "action": torch.zeros(8, 2)}
        >>> batch = TensorDict({**entries, "next": following}, [8])  # of any replay buffer
        >>> bool(learner.update(batch)["loss_qvalue"] > 0)
        True
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        sac: LeanSACLoss,
        *,
        decoder: SynergyMap | None = None,
        behavior: TensorDictModuleBase | None = None,
        terms: Sequence[Term] = (),
        transforms: Sequence[Transform] = (),
        normalizer: RunningNorm | None = None,
        return_scale: ReturnScale | None = None,
        reward: NestedKey = "reward",
        tau: float = 0.005,
        lr: float = 3e-4,
        lr_end: float = 1.0,
        ema_decay: float = 0.0,
        compile: bool = False,
    ) -> None:
        check_real("(0, inf)", lr=lr)
        check_real("[0, 1]", lr_end=lr_end)
        check_real("(0, 1]", tau=tau)
        check_real("[0, 1)", ema_decay=ema_decay)
        _check_networks(sac, actor, decoder)
        self.actor, self.decoder, self.device = actor, decoder, next(actor.parameters()).device
        self.lr_end, self.compile = lr_end, compile
        # The loss creates these lazily; they must exist before optimizer and compiled updates do.
        _ = sac.target_entropy, sac.value_estimator
        units = {"normalizer": normalizer, "return_scale": return_scale, "reward": reward}
        self.objective = Objective(sac, actor, terms, **units, transforms=transforms)
        self.objective.to(self.device)
        self.blueprint = blueprint(self.objective)  # equal ones can be updated in one pass
        self.statistics = self.objective.statistics
        self.targets = [FusedSoftUpdate(sac, tau=tau)]
        self.targets += [term.target for term in terms if term.target is not None]
        self.ema = WarmedUpEMA(actor, ema_decay)
        acting = actor if behavior is None else behavior
        self.behavior = from_observation(acting, normalizer, decoder)
        self.scheduled = [each for each in acting.modules() if isinstance(each, Scheduled)]
        self.policy = from_observation(self.ema.module, normalizer, decoder)
        self.optimizer = make_optimizer(parameter_groups(sac, terms, lr), self.device)
        self.parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self._stepped = list(actor.parameters())
        self._draw = redrawn(self.loss)
        self._compile(self.gradients)

    def update(self, batch: TensorDictBase) -> TensorDictBase:
        """Update once on a batch of transitions [B]; returns scalars to log."""
        return self.updates(self.inputs(batch.unsqueeze(0)))[0]

    def updates(self, inputs: TensorDictBase) -> TensorDictBase:
        """Run k updates on :meth:`inputs` [k], in order; returns scalars to log [k]."""
        scalars = []
        for each in inputs.unbind(0):
            scalars.append(self._step(each))  # `step`, on CUDA replayed as one graph
            self.ema.update()  # reads its count in Python, so it is not part of the graph
        return torch.stack(scalars)

    def step(self, inputs: TensorDictBase) -> TensorDictBase:
        """Update networks, temperature, targets and statistics once; returns scalars to log."""
        gradients, scalars, statistics = self._gradients(inputs)  # `gradients`, compiled
        self.optimizer.step_along(gradients)
        for target in self.targets:
            target.step()
        if statistics:
            torch._foreach_copy_(list(self.statistics.values()), statistics)
        return scalars

    def gradients(self, inputs: TensorDictBase) -> Gradients:
        """Gradients of the objective in the order of ``parameters``. Changes no state."""
        loss, scalars, statistics = self.loss(inputs["batch"], inputs["draws"])
        gradients = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        return gradients, scalars.detach(), statistics

    def loss(
        self, batch: TensorDictBase, draws: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDictBase, tuple[Tensor, ...]]:
        """The objective on a batch [B], scalars to log, and new statistics. Changes no state.

        ``draws`` holds its random numbers, as in :meth:`inputs`; by default it draws them.
        """
        statistics = {name: self.objective.get_buffer(name).clone() for name in self.statistics}
        with drawn_in(draws):
            # Tying weights would leave the copies in a module that is registered under two names.
            loss, scalars = functional_call(self.objective, statistics, (batch,), tie_weights=False)
        return loss, scalars, tuple(statistics.values())

    def inputs(self, batches: TensorDictBase) -> TensorDictBase:
        """Inputs of k updates: these batches [k, B] under ``batch``, and under ``draws`` the random
        numbers of each update in the order in which the objective consumes them."""
        drawn = self._draw(len(batches), batches[0])
        draws = TensorDict({f"{i}": each for i, each in enumerate(drawn)}, [len(batches)])
        return TensorDict({"batch": batches, "draws": draws}, [len(batches)])

    def only(self, *terms: Term) -> SACLearner:
        """A learner that minimizes these terms only and shares this learner's optimizer."""
        twin = copy(self)
        twin.objective = self.objective.only(*terms)
        twin.blueprint = blueprint(twin.objective)
        twin.statistics = {}
        twin.targets = [term.target for term in terms if term.target is not None]
        twin.ema = WarmedUpEMA(nn.Module(), 0.0)  # of nothing: the actor stays
        twin._stepped = list(twin.objective.terms.parameters())
        twin._draw = redrawn(twin.loss)
        twin._compile(twin.gradients)
        return twin

    def observe(self, batch: TensorDictBase) -> None:
        """Update the running statistics with a collected batch [simulators, time]."""
        if self.objective.return_scale is not None:
            reward, done = batch["next", "reward"].squeeze(-1), batch["next", "done"].squeeze(-1)
            self.objective.return_scale.update(reward, done, episode_numbers(batch))
        if self.objective.normalizer is not None:
            self.objective.normalizer.update_moments(batch["observation"])

    def restart(self, actions: int) -> None:
        """Prepare for new episodes in all simulators, after ``actions`` actions of each worker."""
        if self.objective.return_scale is not None:
            self.objective.return_scale.reset_episodes()
        for module in self.scheduled:
            module.restart(actions)

    def advance(self, frames: int, progress: float) -> None:
        """Set learning rates and schedules after a batch; ``progress`` is frames over budget."""
        self.optimizer.scale_rates(1.0 - (1.0 - self.lr_end) * min(1.0, progress))
        for module in self.scheduled:
            module.advance(frames)

    @property
    def num_updates(self) -> int:
        """Updates so far, as counted by the optimizer."""
        return self.optimizer.steps_of(self._stepped)

    @property
    def step_sizes(self) -> tuple[float, ...]:
        """Step sizes in effect: update count, learning rates, target-network and EMA rates."""
        targets = (target.eps for target in self.targets)
        return self.num_updates, *self.optimizer.rates, *targets, self.ema.decay

    @property
    def state(self) -> list[Tensor]:
        """Every tensor that an update modifies, without duplicates, except update counters."""
        updated = [tensor for target in self.targets for tensor in target.target_tensors]
        found = *self.parameters, *updated, *self.ema.tensors, *self.optimizer.moments
        found += tuple(self.statistics.values())
        return list({id(tensor): tensor for tensor in found}.values())

    def mapped(
        self, other: Callable[[Tensor], Tensor], gradients: Callable[[TensorDictBase], Gradients]
    ) -> SACLearner:
        """A copy that updates ``other(tensor)`` for each tensor, along these gradients."""
        twin = copy(self)
        twin.parameters = list(map(other, self.parameters))
        twin.statistics = {name: other(each) for name, each in self.statistics.items()}
        twin.optimizer = self.optimizer.mapped(other)
        twin.targets = [target.mapped(other) for target in self.targets]
        twin.ema = self.ema.mapped(other)
        twin._compile(gradients)
        return twin

    def _compile(self, gradients: Callable[[TensorDictBase], Gradients]) -> None:
        self._gradients = compiled(gradients) if self.compile else gradients
        graphed = self.compile and self.device.type == "cuda"
        self._step = cuda_graph(self.step) if graphed else self.step

    @property
    def components(self) -> dict[str, Any]:
        """Components of a checkpoint; a trained learner acts by ``policy`` alone."""
        return {
            "policy": self.policy,
            "objective": self.objective,
            "ema": self.ema,
            "optimizer": self.optimizer,
        }


def _check_networks(
    sac: LeanSACLoss, actor: TensorDictModuleBase, decoder: SynergyMap | None
) -> None:
    """Raise ``ValueError`` unless the loss trains this actor, through this decoder if any."""
    trained = {id(parameter) for parameter in sac.parameters()}
    if not trained.issuperset(map(id, actor.parameters())):
        raise ValueError("sac is the loss of another actor; pass make_sac_loss(actor, ...).")
    through = () if decoder is None else decoder.parameters()
    decodes = isinstance(sac, SynergySACLoss)
    if decodes != (decoder is not None) or not trained.issuperset(map(id, through)):
        raise ValueError(
            "sac is not a loss through this decoder; pass the same decoder to make_sac_loss and "
            "to the learner, or to neither."
        )
