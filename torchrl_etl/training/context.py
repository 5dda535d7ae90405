"""The context of a run, from which a method builds its learners and stages."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from inspect import signature
from typing import TYPE_CHECKING, Any, TypeAlias

import torch
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from torchrl_etl.checks import check_choice, check_flag, check_integer, naming
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.envs import EnvironmentSpec, make_env
from torchrl_etl.extras import extra
from torchrl_etl.learners import NORMALIZED, SACLearner
from torchrl_etl.modules import (
    HeldNoise,
    ReturnScale,
    RunningNorm,
    SynergyMap,
    UniformWarmup,
    make_actor,
    make_critic,
)
from torchrl_etl.objectives import LeanSACLoss, entropy_target, make_sac_loss
from torchrl_etl.training.evaluation import Evaluation
from torchrl_etl.training.loop import StopOnSignal, run_stage
from torchrl_etl.training.run_folder import RunFolder
from torchrl_etl.training.simulators import env_of_a_collector, stage_seed
from torchrl_etl.training.stage import Stage, check_budget, frames_per_action
from torchrl_etl.training.work import Work

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["Context"]

Actor: TypeAlias = ProbabilisticTensorDictSequential

OF_LEARNER_OR_METHOD = (
    *("actor", "critic", "sac", "noise", "init_random_frames"),
    *("decoder", "prefill", "fit"),
)
"""Settings of the sections ``explore`` and ``learn`` that :meth:`Context.stage` leaves out."""


@dataclass(frozen=True)
class Context:
    """Configuration, folder and environment of a run; builds learners and stages for them.

    Args:
        config (DictConfig): see ``recipes/conf/config.yaml``.
        folder (RunFolder): the run's folder for results.
        say (callable): called with each message for the user, one line each.
    """

    config: DictConfig
    folder: RunFolder
    say: Callable[[str], None] = lambda line: None

    @property
    def device(self) -> torch.device:
        return torch.device(self.config.device)

    @cached_property
    def spec(self) -> EnvironmentSpec:
        """Sizes, bounds and names of the environment."""
        with closing(self.make_env()) as env:
            return EnvironmentSpec.of(env, self.device)

    def options(self, section: str) -> dict[str, Any]:
        """A section of the configuration as plain keyword arguments."""
        with extra("recipes"):
            from omegaconf import OmegaConf
        return OmegaConf.to_container(OmegaConf.select(self.config, section), resolve=True)

    def make_env(self, **options: Any) -> EnvBase:
        """One simulator of the task."""
        return make_env(device=self.device, **{**self.task, **options})

    @property
    def task(self) -> dict[str, Any]:
        """Arguments of :func:`~torchrl_etl.envs.make_env` that name the task."""
        return {"name": self.config.env, **self.task_options}

    @property
    def task_options(self) -> dict[str, Any]:
        """Arguments of :attr:`task` other than the name."""
        return {
            "goal": self.config.goal,
            "action_repeat": self.config.action_repeat,
            "success_key": self.config.success_key,
            "env_kwargs": self.options("env_kwargs"),
        }

    def actor(
        self,
        section: str = "learn",
        *,
        spec: EnvironmentSpec | None = None,
        decoder: SynergyMap | None = None,
        inputs: Mapping[str, int] | None = None,
        make: Callable[..., Actor] = make_actor,
        **options: Any,
    ) -> Actor:
        """Build the actor that ``section`` configures.

        Args:
            section (str): ``"explore"`` or ``"learn"``.

        Keyword Args:
            spec (EnvironmentSpec, optional): environment to act in. Default: the run's.
            decoder (SynergyMap, optional): maps its outputs to actions. Default: they are actions.
            inputs (mapping, optional): sizes of its inputs besides the observation, by key.
            make (callable): builds it. Default: :func:`~torchrl_etl.modules.make_actor`.
            **options: override configured arguments of ``make``, or add others.
        """
        spec = spec or self.spec
        output, out_key = spec.action_spec, "action"
        if decoder is not None:
            output, out_key = decoder.to(self.device).synergy_spec, decoder.in_keys[0]
        sizes, configured = self._inputs(section, spec, inputs), self.options(section)["actor"]
        with naming(f"{section}.actor"):
            configured |= {"out_key": out_key, **options}
            return make(sizes, output, **configured).to(self.device)

    def behavior(self, actor: Actor, section: str = "learn") -> TensorDictModuleBase:
        """The actor with exploration noise, drawn at every step or held for several."""
        noise = self.options(section)["noise"]
        with naming(f"{section}.noise"):
            check_choice("kind", kind := noise.pop("kind"), ("independent", "held"))
            return HeldNoise(actor, **noise) if kind == "held" else actor

    def loss(
        self,
        actor: Actor,
        section: str = "learn",
        *,
        spec: EnvironmentSpec | None = None,
        decoder: SynergyMap | None = None,
        inputs: Mapping[str, int] | None = None,
        entropy_spec: Bounded | None = None,
        **options: Any,
    ) -> LeanSACLoss:
        """Build critics and the SAC loss that ``section`` configures.

        Args:
            actor (ProbabilisticTensorDictSequential): see :meth:`actor`.
            section (str): ``"explore"`` or ``"learn"``.

        Keyword Args:
            spec, decoder, inputs: those of the actor.
            entropy_spec (Bounded, optional): spec of the outputs whose entropy has a target.
                Default: all outputs of the actor.
            **options: override configured arguments of
                :func:`~torchrl_etl.objectives.make_sac_loss`.

        Raises:
            ValueError: if the actor has other inputs, or ``gamma`` or ``return_bound`` is given.
        """
        spec, configured = spec or self.spec, self.options(section)
        if shared := sorted({"gamma", "return_bound"} & {*options}):
            raise ValueError(
                f"{shared[0]} cannot be set here, as n-step targets or the scale of returns use it "
                f"too; change the setting {section}.sac.{shared[0]}."
            )
        sizes = self._inputs(section, spec, inputs)
        if {*sizes} != {*actor.in_keys}:
            raise ValueError(
                f"The actor reads {sorted(actor.in_keys)} but its critics would read "
                f"{sorted(sizes)}; pass loss(..., inputs=) what actor(..., inputs=) got."
            )
        sizes["action"] = spec.action_dim
        with naming(f"{section}.critic"):
            critic = make_critic(sizes, **configured["critic"]).to(self.device)
        output = actor.spec[actor.dist_sample_keys[0]]
        measured = output if entropy_spec is None else entropy_spec
        others = {*signature(SACLearner).parameters, "normalize_observations"}
        sac = {key: value for key, value in configured["sac"].items() if key not in others}
        with naming(f"{section}.sac"):
            entropy = entropy_target(measured, sac.pop("action_std"))
            sac |= {"action_spec": output, "target_entropy": entropy}
            sac["bins"] = configured["critic"].get("bins", 1)
            return make_sac_loss(actor, critic, decoder, **{**sac, **options})

    def learner(
        self,
        actor: Actor | None = None,
        section: str = "learn",
        *,
        spec: EnvironmentSpec | None = None,
        decoder: SynergyMap | None = None,
        loss: LeanSACLoss | None = None,
        behavior: TensorDictModuleBase | None = None,
        **options: Any,
    ) -> SACLearner:
        """Build the learner that ``section`` configures.

        Args:
            actor (ProbabilisticTensorDictSequential, optional): Default: :meth:`actor`.
            section (str): ``"explore"`` or ``"learn"``.

        Keyword Args:
            spec, decoder: those of the actor.
            loss (LeanSACLoss, optional): SAC's losses. Default: :meth:`loss`.
            behavior (TensorDictModuleBase, optional): policy that collects, after
                ``init_random_frames`` of uniform actions. Default: :meth:`behavior`.
            **options: override configured arguments of
                :class:`~torchrl_etl.learners.SACLearner`, or add others, such as ``terms``.
        """
        spec, sac = spec or self.spec, self.options(section)["sac"]
        if actor is None:
            actor = self.actor(section, spec=spec, decoder=decoder)
        if behavior is None:
            behavior = self.behavior(actor, section)
        if uniform := self._uniform_actions(section):
            (out_key,) = actor.dist_sample_keys
            warmup = UniformWarmup(actor.spec[out_key], uniform, action_key=out_key)
            behavior = TensorDictSequential(behavior, warmup)
        if loss is None:
            loss = self.loss(actor, section, spec=spec, decoder=decoder)
        takes = signature(SACLearner).parameters  # the section also configures the loss
        configured = {key: value for key, value in sac.items() if key in takes}
        configured["compile"] = self._compiles(section)
        if sac["normalize_observations"]:
            configured["normalizer"] = RunningNorm(spec.observation_dim)
        if (bound := sac.get("return_bound")) is not None:
            configured["return_scale"] = ReturnScale(sac["gamma"], bound=bound)
        configured |= options
        with naming(f"{section}.sac"):
            return SACLearner(actor, loss, decoder=decoder, behavior=behavior, **configured)

    def _inputs(
        self, section: str, spec: EnvironmentSpec, others: Mapping[str, int] | None
    ) -> dict[str, int]:
        """Sizes of the inputs that actor and critics share, by key."""
        normalize = self.options(section)["sac"]["normalize_observations"]
        with naming(f"{section}.sac"):
            check_flag(normalize_observations=normalize)
        return {NORMALIZED if normalize else "observation": spec.observation_dim, **(others or {})}

    def _uniform_actions(self, section: str) -> int:
        """Actions of each worker that are drawn uniformly at first."""
        frames = self.options(section).get("init_random_frames", 0)
        with naming(section):
            check_integer(0, init_random_frames=frames)
        return self.actions(frames)

    def _compiles(self, section: str) -> bool:
        """Whether to compile updates; by default if the run is long enough to save time."""
        if self.config.compile is not None:
            return self.config.compile
        options = self.options(section)
        with naming(section):
            check_budget(options["frames"], options["replay_ratio"])
        return options["frames"] * options["replay_ratio"] >= 4_000

    def stage(
        self,
        learner: SACLearner,
        section: str = "learn",
        *,
        task: str | None = None,
        env_options: dict[str, bool] | None = None,
        env_transforms: Sequence[Transform] = (),
        **options: Any,
    ) -> Stage:
        """Build the stage that ``section`` configures.

        Args:
            learner (SACLearner): the learner of the stage.
            section (str): ``"explore"`` or ``"learn"``.

        Keyword Args:
            task (str, optional): task in place of the run's, with the goal implied by its name.
            env_options (dict): additional arguments of :func:`~torchrl_etl.envs.make_env`, such as
                ``muscle_lengths=True``.
            env_transforms (sequence of Transform): transforms to append to the environment.
            **options: override configured arguments of :class:`~torchrl_etl.training.Stage`.
        """
        collector = self.options("collector")
        num_envs = collector.pop("num_envs")
        fast = num_envs > 1
        slow = [type(each).__name__ for each in env_transforms if not VectorCollector.takes(each)]
        if fast and slow:
            fast = False
            warnings.warn(
                "Frames are collected with TorchRL's Collector, which is several times slower, "
                f"since {', '.join(slow)} has no array_step and array_reset (see VectorCollector).",
                stacklevel=2,
            )
        collector["collector_class"] = VectorCollector if fast else Collector
        collector |= {engine: self.options(engine) for engine in ("ray", "distributed")}
        other = {"goal": None, "success_key": None} if task else {}  # implied by the task
        make_env = partial(
            env_of_a_collector,
            task or self.config.env,
            num_envs=num_envs,
            transforms=tuple(env_transforms),
            **{**self.task_options, **other, **(env_options or {})},
        )
        configured = self.options(section)
        for key in OF_LEARNER_OR_METHOD:
            configured.pop(key, None)
        fixed = {
            "name": section,
            "updated": learner,
            "seed": stage_seed(self.config.seed, section),
            "gamma": self.config[section].sac.gamma,
            "device": self.device,
            "action_repeat": self.config.action_repeat,
            "restart_seed": self.config.restart_seed,
            "scratch": self.folder.path / "buffer",
            "collector": collector,
        }
        with naming(section):
            return Stage(learner=learner, make_env=make_env, **{**configured, **fixed, **options})

    def actions(self, frames: int) -> int:
        """Actions of each worker, over all its simulators, in this many frames of the run."""
        return frames // frames_per_action(self.options("collector"), self.config.action_repeat)

    def run_stage(
        self, stage: Stage, stop: StopOnSignal, **options: Any
    ) -> Work[Evaluation | None]:
        """Run a stage to its end, see :func:`~torchrl_etl.training.loop.run_stage`."""
        configured = {
            "checkpoint_every": self.config.checkpoint.every,
            "keep": self.config.checkpoint.keep,
            "log_every": self.config.log_every,
            "show_progress": self.config.progress,
        }
        return run_stage(stage, self.folder, stop, **{**configured, **options})

    def seed_everything(self, section: str) -> None:
        """Seed PyTorch for what ``section`` builds."""
        torch.manual_seed(stage_seed(self.config.seed, section))
