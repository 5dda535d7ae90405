"""Soft actor-critic on the task: the control, and the frame that the other learners fill in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import Bounded
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from torchrl_etl.modules import (
    HeldNoise,
    ReturnScale,
    RunningNorm,
    UniformWarmup,
    make_actor,
    make_critic,
    normalize_rows,
)
from torchrl_etl.modules.checks import check_choice
from torchrl_etl.objectives import LeanSACLoss
from torchrl_etl.training.continued_multi_step import ContinuedMultiStep
from torchrl_etl.training.stage import Stage, entropy_target, make_optimizer, ready_for_training

__all__ = ["SACStage"]

NORMALIZED = "normalized_observation"
Noise = Literal["independent", "held"]
Losses = tuple[Tensor, TensorDictBase]


class SACStage(Stage):
    """SAC on all actuators, with ETL's loop, networks, buffer and updates.

    Args:
        make_env (callable): environment to collect from.
        spec (EnvBase): any instance of that environment, to read sizes and bounds from.

    Keyword Args:
        actor, critic (mapping): keyword arguments of :func:`~torchrl_etl.modules.make_actor` and
            :func:`~torchrl_etl.modules.make_critic`.
        sac (mapping): ``gamma``, ``tau``, ``lr``, ``alpha_init``, ``action_std`` (see
            :func:`~torchrl_etl.training.stage.entropy_target`), ``loss_function`` (of scalar
            critics: "l2", "l1" or "smooth_l1"), ``return_bound`` (scale rewards as
            :class:`~torchrl_etl.modules.ReturnScale` does; ``None``: as they are), ``noise``
            ("independent" at every step or "held" for several), ``hold`` (keyword arguments of
            :class:`~torchrl_etl.modules.HeldNoise`), ``normalize_observations`` (actor and
            critics see what :class:`~torchrl_etl.modules.RunningNorm` makes of them),
            ``unit_rows`` (the rows of all their linear layers keep unit length), ``num_critics``
            (the smallest of whose values counts), ``lr_end`` (share of every learning rate that
            is left at the last frame; they fall linearly), ``actor_average`` (the trained policy
            is an exponential average of the actor, see :func:`averaging`; the actor itself collects
            and learns) and ``n_steps`` (rewards in a critic's target before it bootstraps; fewer
            at the end of a batch or an episode. Of the steps between, which the target takes as
            they were collected, no entropy counts).
        init_random_frames (int): frames at the beginning whose actions are uniform within the
            bounds of what the actor emits. Default: 0.
        **stage: see :class:`~torchrl_etl.training.stage.Stage`.

    Raises:
        ValueError: for categorical critics without a bound on returns.
    """

    name = "learn"
    kept = ("observation", "action")
    reward = "reward"

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        spec: EnvBase,
        *,
        actor: Mapping[str, Any],
        critic: Mapping[str, Any],
        sac: Mapping[str, Any],
        device: torch.device,
        init_random_frames: int = 0,
        **stage: Any,
    ) -> None:
        torch.manual_seed(stage["seed"])
        check_choice("sac.noise", sac["noise"], get_args(Noise))
        self.hold = sac["hold"]
        self._frames_per_action = frames_per_action(**stage)
        muscles = spec.full_action_spec_unbatched["action"].to(device)
        self.observation_dim = spec.observation_spec["observation"].shape[-1]
        self.norm = None
        if sac["normalize_observations"]:
            self.norm = RunningNorm(self.observation_dim).to(device)
        inputs = {"observation" if self.norm is None else NORMALIZED: self.observation_dim}
        self.action_spec, out_key = self.emitted(muscles)
        self.actor = self.build_actor(inputs, self.action_spec, out_key=out_key, **actor).to(device)
        value = make_critic({**inputs, "action": muscles.shape[-1]}, **critic).to(device)
        self.average = AveragedModel(self.actor, multi_avg_fn=averaging(sac["actor_average"]))
        self.trained_policy = self.from_raw(self.average.module)
        self.multi_step = None
        if sac["n_steps"] > 1:
            self.multi_step = ContinuedMultiStep(sac["gamma"], sac["n_steps"])
        policy = self.from_raw(self.exploring(sac["noise"]))
        self.warmup = None
        if init_random_frames:
            self.warmup = UniformWarmup(
                self.action_spec, self.actions(init_random_frames), action_key=out_key
            )
            policy = TensorDictSequential(policy, self.warmup)
        super().__init__(make_env, self.policy_of(policy), device=device, **stage)
        bound = sac["return_bound"]
        self.return_scale = None
        if bound is not None:
            self.return_scale = ReturnScale(sac["gamma"], bound=bound).to(device)
        self.sac = self.make_loss(
            value,
            action_spec=self.action_spec,
            target_entropy=self.target_entropy(sac["action_std"]),
            alpha_init=sac["alpha_init"],
            num_qvalue_nets=sac["num_critics"],
            loss_function=sac["loss_function"],
            support=support(critic.get("bins", 1), bound),
        ).to(device)
        self.sac.set_keys(reward=self.reward)
        self._unit_rows = list(linear_weights(self.sac)) if sac["unit_rows"] else []
        self.constrain()
        self.targets = [ready_for_training(self.sac, gamma=sac["gamma"], tau=sac["tau"])]
        self.optimizer = make_optimizer(device, *self.groups(sac["lr"]))
        # A function of the frames alone: a resumed run is where it was.
        falls = 1.0 - sac["lr_end"]
        self.schedule = LambdaLR(
            self.optimizer, lambda _: 1.0 - falls * min(1.0, self.frames / self.budget)
        )

    def actions(self, frames: int) -> int:
        """Actions of each worker, all its rows counted, in so many frames of the run."""
        return frames // self._frames_per_action

    # What other learners fill in ---------------------------------------------------------------

    def emitted(self, muscles: Bounded) -> tuple[Bounded, str]:
        """Bounds and key of what the actor emits."""
        return muscles, "action"

    def build_actor(self, inputs: Any, spec: Bounded, **options: Any) -> ProbabilisticActor:
        return make_actor(inputs, spec, **options)

    def exploring(self, noise: Noise) -> TensorDictModuleBase:
        """The actor as it collects."""
        return HeldNoise(self.actor, **self.hold) if noise == "held" else self.actor

    def from_raw(self, actor: TensorDictModuleBase) -> TensorDictModuleBase:
        """The actor as it reads the environment's own observations."""
        if self.norm is None:
            return actor
        norm = TensorDictModule(self.norm, in_keys=["observation"], out_keys=[NORMALIZED])
        return TensorDictSequential(norm, actor)

    def target_entropy(self, action_std: float | None) -> float | str:
        return entropy_target(self.action_spec, action_std)

    def policy_of(self, actor: TensorDictModuleBase) -> TensorDictModuleBase:
        """What acts in the environment."""
        return actor

    def make_loss(self, critic: TensorDictModuleBase, **options: Any) -> LeanSACLoss:
        return LeanSACLoss(self.actor, critic, **options)

    def groups(self, lr: float) -> list[tuple[list[Tensor], float]]:
        """Trained parameters with their learning rates."""
        return [(list(self.sac.parameters()), lr)]

    def constrain(self) -> None:
        if self._unit_rows:
            normalize_rows(self._unit_rows)

    # What a stage defines ----------------------------------------------------------------------

    def learn(self) -> TensorDictBase | None:
        logs = super().learn()
        if self.progress.updates:
            self.schedule.step()
        return logs

    def update(self) -> TensorDictBase:
        scalars = super().update()
        self.average.update_parameters(self.actor)  # asks its counter: no part of a CUDA graph
        return scalars

    def transitions(self, batch: TensorDictBase) -> TensorDictBase:
        kept = batch.select(*self.kept, ("next", "observation"))
        kept["next"].update(batch["next"].select("done", "terminated"))
        kept["next", "reward"] = self.reward_scale * batch["next", "reward"]
        if self.multi_step is not None:
            single = torch.ones(batch.batch_size, dtype=torch.long, device=self.device)
            kept["steps_to_next_obs"] = batch.get("steps_to_next_obs", single)
        return kept

    def spanned(self, batch: TensorDictBase) -> TensorDictBase:
        return super().spanned(batch) if self.multi_step is None else self.multi_step(batch)

    def gradients(self, batch: TensorDictBase) -> tuple[tuple[Tensor | None, ...], TensorDictBase]:
        return super().gradients(self.observed(batch))

    def losses(self, batch: TensorDictBase) -> Losses:
        out = self.sac(self.scaled(batch))
        return out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"], out

    def observed(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch with the observations that actor and critics read."""
        if self.norm is None:
            return batch
        batch = batch.copy().set(NORMALIZED, self.norm(batch["observation"]))
        return batch.set(("next", NORMALIZED), self.norm(batch["next", "observation"]))

    def scaled(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch with its rewards in the units of what was seen up to now."""
        if self.return_scale is None:
            return batch
        reward = self.return_scale(batch["next", self.reward])
        return batch.copy().set(("next", self.reward), reward)

    def acting(self) -> dict[str, Any]:
        """The parts that a trained policy consists of."""
        return {"actor": self.trained_policy}

    def parts(self) -> dict[str, Any]:
        parts = {"sac": self.sac, "average": self.average, "optimizer": self.optimizer}
        parts |= self.acting()
        return parts if self.return_scale is None else parts | {"return_scale": self.return_scale}

    # What rewards and observations are scaled by -----------------------------------------------

    def restart_collection(self) -> None:
        if self.return_scale is not None:
            self.return_scale.forget()
        if self.multi_step is not None:
            self.multi_step.forget()
        if self.warmup is not None:
            self.warmup.seen = self.actions(self.frames)  # a resumed run goes on where it was
        super().restart_collection()

    def seen(self, batch: TensorDictBase) -> TensorDictBase:
        if self.return_scale is not None:
            reward = self.reward_scale * batch["next", "reward"]
            done = batch["next", "done"]
            self.return_scale.update(reward.squeeze(-1), done.squeeze(-1), episodes(batch))
        if self.norm is not None:
            self.norm.see(batch["observation"])
        return batch


def frames_per_action(*, collector: Mapping[str, Any], action_repeat: int = 1, **stage: Any) -> int:
    """Frames of a run for each action of one of its workers.

    Examples:
        >>> frames_per_action(collector={"kind": "process", "num_workers": 4}, action_repeat=2)
        8
    """
    return action_repeat * (1 if collector["kind"] == "single" else collector["num_workers"])


def episodes(batch: TensorDictBase) -> Tensor:
    """A number for the episode of each transition [*].

    Workers of one machine number theirs together, those on other machines each on their own.
    """
    number = batch["collector", "traj_ids"]
    worker = batch.get(("collector", "worker"), None)
    return number if worker is None else number + (worker << 32)


def linear_weights(sac: LeanSACLoss) -> Iterator[Tensor]:
    """Weights of the linear layers of actor [out, in] and stacked critics [critics, out, in]."""
    for params, ndim in ((sac.actor_network_params, 2), (sac.qvalue_network_params, 3)):
        yield from (p for p in params.parameters() if p.ndim == ndim)


def averaging(share: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Tensor], None]:
    """How :class:`~torch.optim.swa_utils.AveragedModel` takes weights into its average.

    Of the average of ``n`` updates stays :math:`\\min(share, (1 + n) / (10 + n))`, as in
    TensorFlow's ``ExponentialMovingAverage``: it spans a ninth of all updates until it spans
    :math:`1 / (1 - share)` of them, so that a short run does not show what was untrained.

    Examples:
        >>> import torch
        >>> average = [torch.tensor([0.0])]
        >>> averaging(0.9)(average, [torch.tensor([11.0])], torch.tensor(1))
        >>> average  # two elevenths of it stayed
        [tensor([9.])]
    """

    def take(average: Sequence[Tensor], weights: Sequence[Tensor], updates: Tensor) -> None:
        n = int(updates)
        get_ema_multi_avg_fn(min(share, (1 + n) / (10 + n)))(average, weights, updates)

    return take


def support(bins: int, bound: float | None) -> Tensor | None:
    """Where categorical critics put the return; ``None`` for critics of one output.

    Examples:
        >>> support(3, 5.0)
        tensor([-5.,  0.,  5.])
    """
    if bins == 1:
        return None
    if bound is None:
        raise ValueError(
            f"critic.bins is {bins} but sac.return_bound is null; categorical critics need a bound "
            "on returns, such as sac.return_bound=5."
        )
    return torch.linspace(-bound, bound, bins)
