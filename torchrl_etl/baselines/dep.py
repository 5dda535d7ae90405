"""DEP: exploration by a controller that amplifies the movements it senses (Schumacher 2023)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_etl.checks import check_choice, check_integer, check_real
from torchrl_etl.modules.scheduled import Scheduled
from torchrl_etl.objectives.checks import read

__all__ = ["DEPController", "DEPExploration"]

_TINY = 1e-30
_BIAS_STEP, _BIAS_DECAY = 0.05, 0.001


class DEPController:
    r"""Differential extrinsic plasticity: a controller from muscle lengths to muscle commands.

    Muscles whose recent velocities correlate are driven together, which amplifies the body's own
    movements. Nothing is trained: the weights are computed from the latest movements. Each row is
    a separate body.

    Equation: with :math:`l_{min}, l_{max}` the extremes of each length so far and :math:`M = -I`,

        | :math:`s = 2[(l - l_{min})/(l_{max} - l_{min} + 0.1) - 1/2]`
        | :math:`x \leftarrow x + (s - x)/s_{4avg}, \quad \Delta x(t) = x(t) - x(t - 1)`
        | :math:`C = \sum_{k<\tau} [M \Delta x(t - k)]\, \Delta x(t - k - \Delta)^T`
        | :math:`\bar C_i = \kappa C_i / (\|(C M^T)_i\| + tiny)`, or with ``normalize="columns"``
        | :math:`\bar C_{ij} = \kappa C_{ij} / (\|(C M^T)_j\| + tiny)`
        | :math:`q = \bar C x, \quad q \leftarrow q/(\|q\| + tiny)`
        | :math:`h \leftarrow h - clip(bias\_rate \cdot y(t - 1), \pm 0.05) - 0.001 h`
        | :math:`y = \tanh(\kappa q + h)`

    Deviates: from the public code, which scales columns instead of rows (``normalize="columns"``; 6
    to 10 % of commands change sign), leaves the latest movement out of the sum (two terms fewer),
    and counts the jump to a new episode as a movement. Here :meth:`reset` excludes that jump. Only
    the last τ + Δ movements are kept; the public code buffers 200 steps but reads no others.

    Args:
        rows (int): number of bodies.
        num_muscles (int): number n of muscles.

    Keyword Args:
        kappa (float): κ, gain of the commands. Default: 1169.7.
        tau (int): τ, number of steps summed in the matrix. Default: 40.
        bias_rate (float): rate at which the bias counteracts a lasting command. Default: 0.002.
        time_distance (int): Δ, steps from a movement to the one that it causes. Default: 5.
        s4avg (float): number of steps that smooth the sensor, 1 for none. Default: 2.
        normalize (str): ``"rows"`` divides each row of C by its norm, as in the paper;
            ``"columns"`` divides column j by the norm of row j, as in the public code. Default:
            ``"rows"``.
        device (torch.device, optional): device of the lengths.
        dtype (torch.dtype, optional): dtype of the lengths.

    Raises:
        ValueError: if a setting is out of its range.

    Examples:
        >>> import torch
        >>> controller = DEPController(rows=3, num_muscles=2)
        >>> angle = torch.linspace(0, 6, 30).sin()
        >>> for a in angle:
        ...     command = controller.step(torch.stack([a, -a]).expand(3, 2))
        >>> command.shape, bool((command[:, 0] * command[:, 1] < 0).all())  # antagonists
        (torch.Size([3, 2]), True)
    """

    def __init__(
        self,
        rows: int,
        num_muscles: int,
        *,
        kappa: float = 1169.7,
        tau: int = 40,
        bias_rate: float = 0.002,
        time_distance: int = 5,
        s4avg: float = 2.0,
        normalize: Literal["rows", "columns"] = "rows",
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        check_integer(1, num_muscles=num_muscles, tau=tau, time_distance=time_distance)
        check_choice("normalize", normalize, ("rows", "columns"))
        check_real("(0, inf)", kappa=kappa)
        check_real("[0, inf)", bias_rate=bias_rate)
        check_real("[1, inf)", s4avg=s4avg)
        self.kappa, self.tau, self.bias_rate = kappa, tau, bias_rate
        self.time_distance, self.s4avg, self.normalize = time_distance, s4avg, normalize
        nothing = torch.zeros(rows, num_muscles, device=device, dtype=dtype)
        self.shortest, self.longest = nothing + torch.inf, nothing - torch.inf
        self.sensed, self.bias, self.command = nothing, nothing, nothing
        # Newest first.
        self.moves = nothing.unsqueeze(1).repeat(1, tau + time_distance, 1)
        self._jumped = torch.ones(rows, 1, device=device, dtype=torch.bool)

    @property
    def rows(self) -> int:
        return len(self.bias)

    def reset(self, rows: Tensor) -> None:
        """Begin a new episode of some bodies; the jump to its first lengths is not a movement.

        ``rows`` is a mask [rows] or indices. The adapted state (extremes of the lengths, latest
        movements and bias) is kept, as in the public code.
        """
        self._jumped[rows] = True

    @torch.no_grad()
    def step(self, lengths: Tensor) -> Tensor:
        """Adapt to the lengths [rows, n] of one time step; returns the commands y [rows, n]."""
        self._sense(lengths)
        drive = torch.einsum("rij,rj->ri", self.weights(), self.sensed)
        drive = drive / (drive.norm(dim=-1, keepdim=True) + _TINY)
        worn = (self.bias_rate * self.command).clamp(-_BIAS_STEP, _BIAS_STEP)
        self.bias = self.bias - worn - _BIAS_DECAY * self.bias
        self.command = torch.tanh(self.kappa * drive + self.bias)
        return self.command

    def _sense(self, lengths: Tensor) -> None:
        self.shortest = torch.minimum(self.shortest, lengths)
        self.longest = torch.maximum(self.longest, lengths)
        range_ = self.longest - self.shortest + 0.1
        sensor = 2 * ((lengths - self.shortest) / range_ - 0.5)
        smoothed = self.sensed + (sensor - self.sensed) / self.s4avg
        smoothed = torch.where(self._jumped, sensor, smoothed)
        move = (smoothed - self.sensed).masked_fill(self._jumped, 0.0)
        self.moves = torch.cat([move.unsqueeze(1), self.moves[:, :-1]], 1)
        self.sensed = smoothed
        self._jumped = torch.zeros_like(self._jumped)

    def matrix(self) -> Tensor:
        """C [rows, n, n], before normalization."""
        causes = self.moves[:, self.time_distance :]
        return -torch.einsum("rki,rkj->rij", self.moves[:, : self.tau], causes)

    def weights(self) -> Tensor:
        """C̄ [rows, n, n]."""
        matrix = self.matrix()
        # Rows of C and of C Mᵀ have the same norm, as M = -I.
        length = matrix.norm(dim=-1, keepdim=True) + _TINY
        return self.kappa * matrix / (length if self.normalize == "rows" else length.mT)


class DEPExploration(TensorDictModuleBase, Scheduled):
    r"""Replaces some of a policy's actions by those of a :class:`DEPController`.

    Put it after the actor: ``TensorDictSequential(actor, DEPExploration(action_spec))``. DEP acts
    alone for the first ``dep_actions`` actions. Later, each step of the policy may start a short
    burst of DEP's actions, except in every ``policy_every``-th episode. DEP adapts at every step.

    Its state is in neither the tensordict nor the ``state_dict()``, so new weights leave a worker's
    state alone. Row i of a batch must be the same body at every call, as in a collector; another
    number of rows resets everything but :attr:`seen`. Random numbers come from torch's global
    generator. It acts and adapts where exploration is set to random, as in collectors. Otherwise
    (deterministic exploration, or outside :class:`torchrl.envs.set_exploration_type`) actions pass
    unchanged and it does not adapt.

    Equation: see :class:`DEPController`.

    Deviates: the paper explores for MPO and draws once for all its environments. Here any learner
    can be used, and each row draws separately. The controller also adapts in the policy's episodes,
    which the public code leaves out, and a burst ends with its episode.

    Args:
        action_spec (Bounded): the action's leaf, unbatched.

    Keyword Args:
        dep_actions (int): actions in which DEP acts alone, of all rows of this worker together.
            Default: 200000.
        probability (float): probability of a burst at each step of the policy. Default: 4e-4.
        intervention_length (int): steps of a burst. Default: 5.
        policy_every (int): every how many episodes of a row one is the policy's alone. Default: 3.
        action_key (NestedKey): Default: ``"action"``.
        length_key (NestedKey): Default: ``"muscle_length"``.
        init_key (NestedKey): see :class:`torchrl.envs.InitTracker`. Without the entry, all steps
            are one episode. Default: ``"is_init"``.
        **controller: see :class:`DEPController`; the defaults are the paper's for legs.

    Keys:
        reads ``muscle_length`` [*, n], ``action`` [*, n] and, where present, ``is_init`` [*, 1];
        writes ``action`` [*, n] in the bounds of the spec.

    Raises:
        TypeError: if the spec is not bounded, or for an unknown setting.
        ValueError: if the spec is batched or a setting is out of its range; when called, if the
            numbers of lengths and actuators differ.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictSequential
        >>> from torchrl.data import Bounded
        >>> from torchrl.envs import ExplorationType, set_exploration_type
        >>> from torchrl_etl.modules import make_actor
        >>> spec = Bounded(0, 1, shape=(4,))
        >>> actor = make_actor({"observation": 3}, spec)
        >>> policy = TensorDictSequential(actor, DEPExploration(spec))
        >>> entries = {"observation": torch.zeros(2, 3), "muscle_length": torch.rand(2, 4)}
        >>> with set_exploration_type(ExplorationType.RANDOM):
        ...     policy(TensorDict(entries, [2]))["action"]  # nothing has moved yet
        tensor([[0.5000, 0.5000, 0.5000, 0.5000],
                [0.5000, 0.5000, 0.5000, 0.5000]])
    """

    seen: int
    """Actions counted so far; :meth:`restart` sets it."""

    def __init__(
        self,
        action_spec: Bounded,
        *,
        dep_actions: int = 200_000,
        probability: float = 4e-4,
        intervention_length: int = 5,
        policy_every: int = 3,
        action_key: NestedKey = "action",
        length_key: NestedKey = "muscle_length",
        init_key: NestedKey = "is_init",
        **controller: Any,
    ) -> None:
        if not isinstance(action_spec, Bounded):
            raise TypeError(
                f"action_spec is a {type(action_spec).__name__}; pass the action's Bounded leaf, "
                "such as env.full_action_spec_unbatched['action']."
            )
        if action_spec.ndim != 1:
            raise ValueError(
                f"action_spec has shape {list(action_spec.shape)} but must be [actuators]; pass "
                "the unbatched one, such as env.full_action_spec_unbatched['action']."
            )
        check_integer(1, intervention_length=intervention_length, policy_every=policy_every)
        check_integer(0, dep_actions=dep_actions)
        check_real("[0, 1]", probability=probability)
        super().__init__()
        self.dep_actions, self.probability = dep_actions, probability
        self.intervention_length, self.policy_every = intervention_length, policy_every
        self.action_key, self.length_key = unravel_key(action_key), unravel_key(length_key)
        self.init_key = unravel_key(init_key)
        self.in_keys = [self.length_key, self.action_key, self.init_key]
        self.out_keys = [self.action_key]
        self.register_buffer("low", action_spec.space.low.clone(), persistent=False)
        self.register_buffer("high", action_spec.space.high.clone(), persistent=False)
        self.seen, self._settings = 0, controller
        self._start(torch.empty(0, action_spec.shape[0]))

    def restart(self, actions: int) -> None:
        self.seen = actions

    def _start(self, lengths: Tensor) -> None:
        # Not buffers: a collector's weight update would overwrite them with the learner's.
        rows, device = len(lengths), lengths.device
        self.controller = DEPController(
            *lengths.shape, **self._settings, device=device, dtype=lengths.dtype
        )
        self._burst_left = torch.zeros(rows, device=device, dtype=torch.long)
        self._episode = torch.zeros(rows, device=device, dtype=torch.long)  # the first is 1

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Also returns if none is set: a collector calls its policy once while it is built, which is
        # not a step of a body.
        if exploration_type() is not ExplorationType.RANDOM:
            return tensordict
        lengths = self._lengths(tensordict)
        known = self.controller.bias
        if (lengths.shape, lengths.device) != (known.shape, known.device):
            self._start(lengths)
        self._begin_episodes(tensordict)
        is_dep = self._is_dep()
        command = self.controller.step(lengths)
        self.seen += len(lengths)

        action = tensordict.get(self.action_key)
        dep_action = self.low + (command.to(self.low) + 1) / 2 * (self.high - self.low)
        is_dep = is_dep.view(*action.shape[:-1], 1)
        action = torch.where(is_dep, dep_action.view_as(action).to(action), action)
        return tensordict.set(self.action_key, action)

    def _lengths(self, tensordict: TensorDictBase) -> Tensor:
        """Muscle lengths [rows, n]."""
        cure = "build the environment with make_env(..., muscle_lengths=True)"
        lengths = read("DEPExploration", tensordict, self.length_key, cure=cure)
        if lengths.shape[-1] != len(self.low):
            raise ValueError(
                f"{self.length_key!r} has {lengths.shape[-1]} entries for {len(self.low)} "
                "actuators; DEP needs the length of each, in the order of the action."
            )
        return lengths.reshape(-1, len(self.low))

    def _begin_episodes(self, tensordict: TensorDictBase) -> None:
        begins = self._episode == 0
        is_init = tensordict.get(self.init_key, None)
        if is_init is not None:
            begins = begins | is_init.reshape(-1)
        self._episode += begins
        self._burst_left[begins] = 0
        self.controller.reset(begins)

    def _is_dep(self) -> Tensor:
        """Whether DEP acts [rows]; where it does not, also draws whether a burst begins next."""
        bursting = self._burst_left > 0
        if self.seen < self.dep_actions:
            return torch.ones_like(bursting)
        alone = self._episode % self.policy_every == 0
        draw = torch.rand(len(bursting), device=bursting.device) < self.probability
        begun = (draw & ~bursting & ~alone) * self.intervention_length
        self._burst_left = (self._burst_left - 1).clamp_min(0) + begun
        return bursting
