"""A whole run: the method's preparation, learning the task, and a summary."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import Checkpoint
from torchrl.envs import EnvBase

from torchrl_etl.checks import naming
from torchrl_etl.collectors import start_resource_tracker
from torchrl_etl.envs import resolve_task
from torchrl_etl.extras import extra
from torchrl_etl.methods import METHODS, Method
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.config import bfloat16_warning, validate
from torchrl_etl.training.context import Context
from torchrl_etl.training.evaluation import Evaluation, evaluate_task
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.run_folder import RunFolder, facts
from torchrl_etl.training.stage import Stage
from torchrl_etl.training.work import Work, run_alone
from torchrl_etl.user_code import find_class

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["Experiment"]


class Experiment:
    """One run from a resolved configuration.

    Args:
        config (DictConfig): see ``recipes/conf/config.yaml``.

    Keyword Args:
        resume (path, optional): the run folder to resume.
        unique (bool): whether to number the run folder if another run has taken its name.
            Default: ``False``.
        say (callable): receives messages for the user, one line each. Default: no messages.

    Raises:
        ValueError: if the configuration is invalid.
    """

    def __init__(
        self,
        config: DictConfig,
        *,
        resume: Path | None = None,
        unique: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        with extra("recipes"):
            from omegaconf import OmegaConf
        start_resource_tracker()
        validate(config)
        with naming("method"):
            method = find_class(config.method.get("kind"), METHODS, Method)
        self.config = config.copy()
        self.task = resolve_task(config.env, config.goal)
        path = Path(resume or config.run_dir).expanduser()
        self.folder = RunFolder(path, self.config, unique=unique)
        self.context = Context(self.config, self.folder, say)
        if resume is not None:  # older runs may hold settings that their method overrode
            for key, value, _ in method.fixed_settings:
                OmegaConf.update(self.config, key, value)
        self.method = method(self.context)
        self.method.check()
        if config.frames is not None:
            self._divide_frames()
        if warning := bfloat16_warning(self.config):
            say(f"Warning: {warning}")
        self.resume = resume is not None

    def run(self) -> dict[str, Any]:
        """Run the configured stages; returns the content of ``summary.json``, without versions."""
        with StopOnSignal() as stop:
            return run_alone(self.work(stop))

    def work(self, stop: StopOnSignal) -> Work[dict[str, Any]]:
        """:meth:`run` as a generator that pauses at each update, see
        :func:`~torchrl_etl.training.run_interleaved`.

        Args:
            stop (StopOnSignal): checked after every batch.
        """
        self.folder.open(resume=self.resume)
        self.context.say(f"Run folder: {self.folder.path}")
        if self.config.threads:
            torch.set_num_threads(self.config.threads)
        summary: dict[str, Any] = {
            "env": self.config.env,
            "goal": self.task.goal,
            "seed": self.config.seed,
        }
        with closing(self.folder):
            summary |= yield from self.method.prepare(stop)
            if self.config.stage != "explore":
                summary["learn"] = yield from self._learn(stop)
            self.folder.write_json("summary.json", {**summary, "versions": facts()})
        return summary

    def learned(self) -> Stage:
        """The learning stage with the policy and counters of its newest checkpoint.

        Raises:
            FileNotFoundError: if the run has no checkpoint of this stage.
        """
        stage = self.method.stage()
        folder = Checkpoints(self.folder.checkpoints(stage.name), keep_last=2).newest_whole()
        if folder is None:
            raise FileNotFoundError(
                f"{self.folder.path} has no complete checkpoint of stage 2; evaluate a run that "
                "has saved one."
            )
        Checkpoint(policy=stage.learner.policy, progress=stage.progress).load(folder)
        return stage

    def untrained(self) -> TensorDictModuleBase:
        """The initial policy, with weights drawn from the run's seed and the initial synergies, if
        any."""
        return self.method.stage().learner.policy

    def evaluator(self, stage: Stage, env: EnvBase | None = None) -> Callable[[], Evaluation]:
        """A function that evaluates the stage's current policy on the evaluation seeds.

        It uses ``env``, or one simulator of its own, which is left open.
        """
        return partial(
            evaluate_task,
            stage.learner.policy,
            self.context.make_env() if env is None else env,
            self.context.task,
            episodes=self.config.evaluation.episodes,
        )

    def _learn(self, stop: StopOnSignal) -> Work[dict[str, Any]]:
        stage, charged = self.method.stage(), self.method.frames_before()
        self.method.begin(stage)
        with closing(self.context.make_env()) as env:
            evaluator = self.evaluator(stage, env)
            last = yield from self.context.run_stage(
                stage,
                stop,
                evaluate=evaluator,
                evaluate_every=self.config.evaluation.every,
                offset=charged,
            )
            after = last or evaluator()
        if self.config.pictures:
            self._draw_curves(charged)
        summary: dict[str, Any] = {"frames": stage.frames, "frames_charged": charged + stage.frames}
        for key, value in after.intervals().items():
            before = self.folder.series(f"learn/eval/{key}")[1]
            summary[key] = {
                "before": before[0] if before else math.nan,
                "after": value.mean,
                "low": value.low,
                "high": value.high,
            }
        return summary

    def _draw_curves(self, charged: int) -> None:
        from torchrl_etl.analysis import learning_curves

        solved = self.folder.series("learn/eval/solved")
        learning_curves(
            self.folder.series("learn/eval/return"),
            self.folder.pictures / "learning_curves.png",
            solved=solved if solved[0] else None,
            explore_frames=charged or None,
            title=f"{self.config.env}{self.task.goal_in_words}",
        )

    def _divide_frames(self) -> None:
        """Give the learning stage the frames that its preparation leaves."""
        left = self.config.frames - self.method.charged_frames
        if left < 1:
            raise ValueError(
                f"frames is {self.config.frames}, but the stages before learning take "
                f"{self.method.charged_frames}; raise frames, or shorten those stages."
            )
        self.config.learn.frames = left
