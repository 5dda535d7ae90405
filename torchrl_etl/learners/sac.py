"""Soft actor-critic: everything that one update touches, and the update."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, Literal, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.data import Bounded
from torchrl.envs.transforms import Transform

from torchrl_etl.checks import check_flag, check_real
from torchrl_etl.draws import redrawn
from torchrl_etl.learners.compiled import compiled, cuda_graph
from torchrl_etl.learners.ema import WarmedUpEMA
from torchrl_etl.learners.objective import Objective
from torchrl_etl.learners.parts import (
    drawn_in,
    episode_numbers,
    from_observation,
    linear_weights,
    make_loss,
    make_optimizer,
    make_return_scale,
    parameter_groups,
)
from torchrl_etl.learners.term import Term
from torchrl_etl.modules import RunningNorm, SynergyMap, normalize_rows
from torchrl_etl.objectives import FusedSoftUpdate

__all__ = ["Gradients", "SACLearner"]

Gradients: TypeAlias = tuple[tuple[Tensor | None, ...], TensorDictBase, tuple[Tensor, ...]]
"""Gradients in the order of ``parameters``, scalars to log, and new values of ``statistics``."""


class SACLearner:
    """Soft actor-critic that owns its networks, targets, statistics and optimizer.

    Both stages of ETL and all its rivals are this class with other objects handed to it.

    Args:
        actor (ProbabilisticTensorDictSequential): emits an action, or with a decoder synergies.
        critic (TensorDictModule): values an action; it is copied ``num_critics`` times.

    Keyword Args:
        action_spec (Bounded): what the actor emits, unbatched.
        decoder (SynergyMap, optional): turns what the actor emits into actions.
        train_decoder (bool): let the actor loss reach the decoder. Default: ``False``.
        behavior (TensorDictModuleBase, optional): the actor with its exploration noise, which
            collects. Default: the actor.
        terms (sequence of Term): further losses. Default: none.
        transforms (sequence of Transform): what each batch goes through at its update, with all
            networks as they are by then: a bonus, say. What one reads and does not hold is in its
            attribute ``networks``. Default: none.
        normalizer (RunningNorm, optional): the networks read
            :data:`~torchrl_etl.learners.NORMALIZED`, which it makes of ``observation``.
        reward (NestedKey): what SAC learns on. Default: ``"reward"``.
        gamma (float): discount factor. Default: 0.99.
        tau (float): EMA rate of the target critics. Default: 0.005.
        lr, lr_end (float): learning rate, and the share of all learning rates that is left at the
            last frame; they fall linearly. Default: 3e-4 and 1.
        ema_decay (float): decay of the EMA of the actor that is evaluated and saved. Default: 0.
        alpha_init (float): initial temperature. Default: 1.
        target_entropy (float or "auto"): see :func:`entropy_target`. Default: ``"auto"``.
        counted (int, optional): entropy is that of so many leading entries of what the actor
            emits. Default: of the action.
        num_critics (int): the smallest of whose values counts. Default: 2.
        loss_function (str): error of scalar critics. Default: ``"l2"``.
        return_bound (float, optional): rewards are scaled so that returns stay within it.
        bins (int): above 1, critics are categorical with so many returns in ±``return_bound``.
        unit_rows (bool): rows of all linear layers keep unit length. Default: ``False``.
        on_frames (sequence of callable): told the number of frames after each batch.
        on_restart (sequence of callable): told, where new episodes begin, how many actions each
            worker has taken; parts of the behavior policy that count actions go on from there.
        compile (bool): compile updates; on CUDA they also become one CUDA graph.

    Raises:
        ValueError: for categorical critics without a bound on returns.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.learners import SACLearner
        >>> from torchrl_etl.modules import make_actor, make_critic
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> actor = make_actor({"observation": 3}, spec)
        >>> critic = make_critic({"observation": 3, "action": 2})
        >>> learner = SACLearner(actor, critic, action_spec=spec)
        >>> [entry for entry in learner.policy.in_keys]
        ['observation']
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModule,
        *,
        action_spec: Bounded,
        decoder: SynergyMap | None = None,
        train_decoder: bool = False,
        behavior: TensorDictModuleBase | None = None,
        terms: Sequence[Term] = (),
        transforms: Sequence[Transform] = (),
        normalizer: RunningNorm | None = None,
        reward: NestedKey = "reward",
        gamma: float = 0.99,
        tau: float = 0.005,
        lr: float = 3e-4,
        lr_end: float = 1.0,
        ema_decay: float = 0.0,
        alpha_init: float = 1.0,
        target_entropy: float | Literal["auto"] = "auto",
        counted: int | None = None,
        num_critics: int = 2,
        loss_function: str = "l2",
        return_bound: float | None = None,
        bins: int = 1,
        unit_rows: bool = False,
        on_frames: Sequence[Callable[[int], None]] = (),
        on_restart: Sequence[Callable[[int], None]] = (),
        compile: bool = False,
    ) -> None:
        check_real("(0, inf)", lr=lr)
        check_real("[0, 1]", lr_end=lr_end)
        check_real("(0, 1]", tau=tau)
        check_real("[0, 1)", ema_decay=ema_decay)
        check_flag(unit_rows=unit_rows)
        self.actor, self.decoder, self.device = actor, decoder, next(actor.parameters()).device
        self.gamma, self.lr_end, self.compile = gamma, lr_end, compile
        self.on_frames, self.on_restart = on_frames, on_restart
        decoded = {"action_spec": action_spec, "decoder": decoder, "train_decoder": train_decoder}
        entropy = {"target_entropy": target_entropy, "counted": counted, "alpha_init": alpha_init}
        critics = {"num_critics": num_critics, "bins": bins, "loss_function": loss_function}
        scale = make_return_scale(gamma, return_bound)
        sac = make_loss(actor, critic, gamma, return_bound, **decoded, **entropy, **critics)
        units = {"normalizer": normalizer, "return_scale": scale, "reward": reward}
        self.objective = Objective(sac, actor, terms, **units, transforms=transforms)
        self.objective.to(self.device)
        self.statistics = self.objective.statistics
        self.targets = [FusedSoftUpdate(sac, tau=tau)]
        self.targets += [term.target for term in terms if term.target is not None]
        self.ema = WarmedUpEMA(actor, ema_decay)
        acting = actor if behavior is None else behavior
        self.behavior = from_observation(acting, normalizer, decoder)
        self.policy = from_observation(self.ema.module, normalizer, decoder)
        self.unit_rows = list(linear_weights(sac)) if unit_rows else []
        normalize_rows(self.unit_rows)
        self.optimizer = make_optimizer(parameter_groups(sac, terms, lr), self.device)
        self.parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self._stepped = list(actor.parameters())
        self._draw = redrawn(self._loss)
        self._step_along(self.gradients)

    def update(self, batch: TensorDictBase) -> TensorDictBase:
        """Learn from a batch of transitions [B]; returns scalars to log."""
        return self.updates(self.inputs(batch.unsqueeze(0)))[0]

    def updates(self, inputs: TensorDictBase) -> TensorDictBase:
        """Learn from :meth:`inputs` [k], one after the other; returns scalars to log [k]."""
        scalars = []
        for each in inputs.unbind(0):
            scalars.append(self._step(each))
            self.ema.follow()  # counts in Python: no part of a CUDA graph
        return torch.stack(scalars)

    def inputs(self, batches: TensorDictBase) -> TensorDictBase:
        """What updates read [k]: under ``batch`` these batches [k, B], and under ``draws`` the
        random numbers of each, in the order in which the objective takes them."""
        drawn = self._draw(len(batches), batches[0])
        draws = TensorDict({f"{i}": each for i, each in enumerate(drawn)}, [len(batches)])
        return TensorDict({"batch": batches, "draws": draws}, [len(batches)])

    def step(self, inputs: TensorDictBase) -> TensorDictBase:
        """Critics, actor, temperature and terms take a gradient step; their targets follow."""
        gradients, scalars, statistics = self._gradients(inputs)
        self.descend(gradients)
        if statistics:
            torch._foreach_copy_(list(self.statistics.values()), statistics)
        return scalars

    def descend(self, gradients: Sequence[Tensor | None]) -> None:
        """A step of the optimizer along gradients in the order of ``parameters``."""
        self.optimizer.step_along(gradients)
        normalize_rows(self.unit_rows)
        for target in self.targets:
            target.step()

    def gradients(self, inputs: TensorDictBase) -> Gradients:
        """Those of the objective, in the order of ``parameters``; nothing is changed."""
        loss, scalars, statistics = self.loss(inputs)
        gradients = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        return gradients, scalars.detach(), statistics

    def loss(self, inputs: TensorDictBase) -> tuple[Tensor, TensorDictBase, tuple[Tensor, ...]]:
        """The objective, with these random numbers, scalars to log, and new statistics."""
        with drawn_in(inputs):
            return self._loss(inputs["batch"])

    def _loss(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase, tuple[Tensor, ...]]:
        statistics = {name: self.objective.get_buffer(name).clone() for name in self.statistics}
        # One module of two names would be left with the copies if those were tied.
        loss, scalars = functional_call(self.objective, statistics, (batch,), tie_weights=False)
        return loss, scalars, tuple(statistics.values())

    def only(self, *terms: Term) -> SACLearner:
        """A learner that takes steps on these terms alone, with this one's optimizer."""
        twin = copy(self)
        twin.objective = self.objective.only(*terms)
        twin.statistics, twin.unit_rows = {}, []
        twin.targets = [term.target for term in terms if term.target is not None]
        twin.ema = WarmedUpEMA(nn.Module(), 0.0)
        twin._stepped = list(twin.objective.terms.parameters())
        twin._draw = redrawn(twin._loss)
        twin._step_along(twin.gradients)
        return twin

    def observe(self, batch: TensorDictBase) -> None:
        """Take a batch [simulators, time] as it was collected into the running statistics."""
        if self.objective.return_scale is not None:
            reward, done = batch["next", "reward"].squeeze(-1), batch["next", "done"].squeeze(-1)
            self.objective.return_scale.update(reward, done, episode_numbers(batch))
        if self.objective.normalizer is not None:
            self.objective.normalizer.see(batch["observation"])

    def restart(self, actions: int) -> None:
        """All episodes begin anew, when each worker has taken so many actions."""
        if self.objective.return_scale is not None:
            self.objective.return_scale.forget()
        for tell in self.on_restart:
            tell(actions)

    def advance(self, frames: int, progress: float) -> None:
        """Set what depends on the number of frames, and on the share of all frames that it is."""
        self.optimizer.scale_rates(1.0 - (1.0 - self.lr_end) * min(1.0, progress))
        for tell in self.on_frames:
            tell(frames)

    @property
    def num_updates(self) -> int:
        """Updates up to now, as the optimizer has counted them."""
        return self.optimizer.steps_of(self._stepped)

    @property
    def pace(self) -> tuple[float, ...]:
        """How far a step goes now: number of updates, learning rates, rates of targets and EMA."""
        targets = (target.eps for target in self.targets)
        return self.num_updates, *self.optimizer.rates, *targets, self.ema.decay

    @property
    def state(self) -> list[Tensor]:
        """All that an update changes, each tensor once, except the numbers of updates."""
        followers = [tensor for target in self.targets for tensor in target.followers]
        found = *self.parameters, *followers, *self.ema.tensors, *self.optimizer.moments
        found += tuple(self.statistics.values())
        return list({id(tensor): tensor for tensor in found}.values())

    def over(
        self, other: Callable[[Tensor], Tensor], gradients: Callable[[TensorDictBase], Gradients]
    ) -> SACLearner:
        """A learner of the same updates along other gradients, of other parameters and targets."""
        twin = copy(self)
        twin.parameters = list(map(other, self.parameters))
        twin.unit_rows = list(map(other, self.unit_rows))
        twin.statistics = {name: other(each) for name, each in self.statistics.items()}
        twin.optimizer = self.optimizer.over(other)
        twin.targets = [target.over(other) for target in self.targets]
        twin.ema = self.ema.over(other)
        twin._step_along(gradients)
        return twin

    def _step_along(self, gradients: Callable[[TensorDictBase], Gradients]) -> None:
        self._gradients = compiled(gradients) if self.compile else gradients
        graphed = self.compile and self.device.type == "cuda"
        self._step = cuda_graph(self.step) if graphed else self.step

    @property
    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds; ``policy`` alone is what a trained learner acts by."""
        return {
            "policy": self.policy,
            "objective": self.objective,
            "ema": self.ema,
            "optimizer": self.optimizer,
        }
