"""The context of a run, from which a method builds its learners and stages."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import torch
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, InitTracker, RewardSum, TransformedEnv
from torchrl.envs.transforms import Transform

from torchrl_etl.checks import check_integer, naming
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.envs import EnvironmentSpec, make_env
from torchrl_etl.extras import extra
from torchrl_etl.learners import SACLearner, build_learner
from torchrl_etl.training.evaluation import Evaluation
from torchrl_etl.training.loop import StopOnSignal, run_stage
from torchrl_etl.training.run_folder import RunFolder
from torchrl_etl.training.stage import Stage, check_budget, frames_per_action
from torchrl_etl.training.work import Work

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["Context"]

NOT_OF_THE_STAGE = (
    *("actor", "critic", "sac", "noise", "init_random_frames"),  # the learner's
    *("decoder", "prefill", "fit"),  # the method's
)


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
        return EnvironmentSpec.of(self.make_env(), self.device)

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

    def learner(
        self, section: str = "learn", *, spec: EnvironmentSpec | None = None, **parts: Any
    ) -> SACLearner:
        """Build the learner that ``section`` configures.

        Args:
            section (str): ``"explore"`` or ``"learn"``.

        Keyword Args:
            spec (EnvironmentSpec, optional): environment to learn in. Default: the run's.
            **parts: see :func:`~torchrl_etl.learners.build_learner`.
        """
        spec = spec or self.spec
        options = self.options(section)
        configured = {key: options[key] for key in ("actor", "critic", "sac", "noise")}
        compile = self.config.compile
        if compile is None:  # compile only if the run is long enough to save time
            with naming(section):
                check_budget(options["frames"], options["replay_ratio"])
            compile = options["frames"] * options["replay_ratio"] >= 4_000
        configured["sac"]["compile"] = compile
        random = options.get("init_random_frames", 0)
        with naming(section):
            check_integer(0, init_random_frames=random)
        configured["init_random_actions"] = self.actions(random)
        with naming(section):
            return build_learner(spec.observation_dim, spec.action_spec, **{**configured, **parts})

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
        slow = [type(each).__name__ for each in env_transforms if not VectorCollector.takes(each)]
        if num_envs > 1 and slow:
            warnings.warn(
                "Frames are collected with TorchRL's Collector, which is several times slower, "
                f"since {', '.join(slow)} has no array_step and array_reset (see VectorCollector).",
                stacklevel=2,
            )
        fast = num_envs > 1 and not slow
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
        for key in NOT_OF_THE_STAGE:
            configured.pop(key, None)
        fixed = {
            "name": section,
            "seed": stage_seed(self.config.seed, section),
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


def stage_seed(seed: int, section: str) -> int:
    """Seed of a stage: even for ``"explore"``, odd for ``"learn"``."""
    return 2 * seed + (section != "explore")


def env_of_a_collector(name: str, transforms: Sequence[Transform], **kwargs: Any) -> TransformedEnv:
    """Build simulators with the transforms that loop and stage need; picklable for workers."""
    own = [transform.clone() for transform in transforms]
    return TransformedEnv(
        make_env(name, **kwargs, device="cpu"), Compose(RewardSum(), InitTracker(), *own)
    )
