"""A whole run: explore, condense, learn, report."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, InitTracker, RewardSum, TransformedEnv

from torchrl_etl.analysis import learning_curves
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.envs import actuator_names, episode_length, make_env, resolve_task
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.modules.atomic_files import surviving_folder, write_atomically
from torchrl_etl.modules.bundle import BundleInfo, check_compatible, load_bundle, save_bundle
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.config import validate
from torchrl_etl.training.evaluation import Evaluation, evaluate
from torchrl_etl.training.explore import ExploreStage
from torchrl_etl.training.learn import LearnStage
from torchrl_etl.training.loop import StopOnSignal, run_stage
from torchrl_etl.training.methods import METHODS
from torchrl_etl.training.run_folder import RunFolder, facts
from torchrl_etl.training.sac import SACStage
from torchrl_etl.training.synergy_report import describe_synergies, draw_synergies
from torchrl_etl.transforms import SynergyAction

__all__ = ["MOST_SYNERGIES", "Experiment", "default_num_synergies"]

MOST_SYNERGIES = 8
"""d of bodies with at least twice as many actuators, among them all of the paper's tasks."""


def default_num_synergies(actuators: int) -> int:
    """d for a body: half of its actuators, between 1 and 8.

    Examples:
        >>> [default_num_synergies(n) for n in (1, 6, 21, 80)]
        [1, 3, 8, 8]
    """
    return min(MOST_SYNERGIES, max(1, actuators // 2))


class Experiment:
    """One run of ETL from a resolved configuration.

    Args:
        config (DictConfig): see ``recipes/conf/config.yaml``.

    Keyword Args:
        resume (path, optional): the run folder to go on in.
        say (callable): where messages for a person go, one line each. Default: nowhere.

    Raises:
        ValueError: if the configuration is not one that can run.
    """

    def __init__(
        self,
        config: DictConfig,
        *,
        resume: Path | None = None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        validate(config)
        self.config, self.say = config.copy(), say
        self.device = torch.device(config.device)
        self.path = resume or Path(config.run_dir)
        self.task = resolve_task(config.env, config.goal)
        self._variant = {"goal": config.goal, "action_repeat": config.action_repeat}
        self.make_env = partial(make_env, config.env, **self._variant, device=self.device)
        self.spec = self.make_env()
        self.actuators = actuator_names(self.spec)
        self.method = None  # ETL, whose stages are below
        if config.method.learner != "etl":
            self.method = METHODS[config.method.learner](self)
        if config.synergies is not None:
            self._take_bundle()
        if config.frames is not None:
            self._divide_frames()
        self._settle_num_synergies()
        self._build_once()
        self.resume = resume is not None
        self.folder = RunFolder(self.path, self.config)

    def run(self) -> dict[str, Any]:
        """Run the stages that the configuration asks for; returns what ``summary.json`` holds."""
        self.folder.open(resume=self.resume)
        if self.config.threads:
            torch.set_num_threads(self.config.threads)
        summary: dict[str, Any] = {
            "env": self.config.env,
            "goal": self.task.goal,
            "seed": self.config.seed,
        }
        with StopOnSignal() as stop, closing(self.folder):
            if self.method is None:
                decoder, charged, summary["synergies"] = self._synergies(stop)
            else:
                decoder, charged = None, self.method.frames
                summary |= self.method.prepare(stop)
            if self.config.stage != "explore":
                summary["learn"] = self._learn(decoder, charged, stop)
            self.folder.write_json("summary.json", {**summary, "versions": facts()})
        return summary

    def _synergies(self, stop: StopOnSignal) -> tuple[SynergyDecoder, int, dict[str, Any]]:
        """The decoder, the frames it took in this run, and what is known of it."""
        given = self.config.synergies is not None
        if not given and not surviving_folder(self.folder.synergies).exists():
            self._explore(stop)
        decoder, info = self._decoder()
        return decoder, 0 if given else info.facts["frames"], {"task": info.task, **info.facts}

    # Stage 1 -----------------------------------------------------------------------------------

    def explore_stage(self) -> ExploreStage:
        """Stage 1 as configured, before its first frame."""
        return ExploreStage(
            self._env_maker(activations=self._shows_activations),
            self.spec,
            num_synergies=self.config.num_synergies,
            seed=2 * self.config.seed,
            device=self.device,
            **self._options("explore"),
        )

    def _explore(self, stop: StopOnSignal) -> None:
        """Explore and leave a bundle in the run folder; that it is there says that this is done."""
        stage = self.explore_stage()
        run_stage(stage, self.folder, stop, **self.loop_options())
        torch.manual_seed(stage.seed)  # finishing gives the same whether or not it was resumed
        decoder = stage.finish(stop.check)
        numbers, warnings = describe_synergies(stage.gmvae, decoder, stage.actions())
        numbers |= {"direction_alignment": stage.alignment(), "frames": stage.frames}
        for warning in warnings:
            self.say(f"Warning: {warning}")
        if self.config.pictures:
            self._draw_synergies(stage, decoder, stop)
        if self._reuses:
            rows = stage.explored(decoder).flatten_keys(".").cpu()
            tensors = {key: value.contiguous() for key, value in rows.items()}
            write_atomically(self.folder.explored, safetensors.torch.save(tensors))
        save_bundle(
            decoder,
            self.folder.synergies,
            task=self.task.env_id,
            actuators=self.actuators,
            num_components=stage.gmvae.num_components,
            facts={**numbers, "seed": self.config.seed, **facts()},
        )

    def _draw_synergies(
        self, stage: ExploreStage, decoder: SynergyDecoder, stop: StopOnSignal
    ) -> None:
        try:
            draw_synergies(
                stage,
                decoder,
                self.actuators,
                self.folder.pictures,
                **self.config.vaf_curve,
                on_update=stop.check,
            )
        except Exception as error:  # whatever a picture meets, the synergies are worth keeping
            self.say(f"Warning: the pictures of the synergies could not be drawn ({error}).")

    # Stage 2 -----------------------------------------------------------------------------------

    def learn_stage(self, decoder: SynergyDecoder | None) -> SACStage:
        """Stage 2 as configured, before its first frame; without a decoder, that of a rival."""
        if decoder is None:
            return self.method.stage()
        learn = self.config.learn
        tuning = {key: learn[key] for key in ("fine_tuning", "decoder_lr", "anchor")}
        given = self.config.explore.frames if self._reuses else 0
        return LearnStage(**self.learner_options(), decoder=decoder, given=given, **tuning)

    def learner_options(self, **env_options: bool) -> dict[str, Any]:
        """Arguments that every stage takes that learns the task, as configured."""
        options = self._options("learn")
        for of_a_decoder in ("fine_tuning", "decoder_lr", "anchor", "reuse_exploration"):
            del options[of_a_decoder]
        return {
            "make_env": self._env_maker(**env_options),
            "spec": self.spec,
            "seed": 2 * self.config.seed + 1,
            "device": self.device,
            **options,
        }

    def blank_decoder(self) -> SynergyDecoder:
        """An untrained decoder of the sizes that the configuration asks for."""
        space = self.spec.full_action_spec_unbatched["action"].space
        return SynergyDecoder(
            self.config.num_synergies,
            len(self.actuators),
            low=space.low,
            high=space.high,
            residual=self.config.learn.residual,
        )

    def learned(self) -> SACStage:
        """Stage 2 with the weights of its newest whole checkpoint.

        Raises:
            FileNotFoundError: if the run has no such checkpoint.
        """
        folder = Checkpoints(self.folder.checkpoints(LearnStage.name), keep_last=2).newest_whole()
        if folder is None:
            raise FileNotFoundError(
                f"{self.folder.path} holds no whole checkpoint of stage 2; evaluate a run that has "
                "begun to learn."
            )
        decoder = self._decoder()[0] if self.method is None else None
        stage = self.learn_stage(decoder)
        Checkpoint(**stage.acting()).load(folder)
        return stage

    def _decoder(self) -> tuple[SynergyDecoder, BundleInfo]:
        bundle = self.config.synergies or self.folder.synergies
        return load_bundle(bundle, residual=self.config.learn.residual)

    def evaluation_env(self, stage: SACStage) -> EnvBase:
        """One simulator, driven by the stage's decoder if it has one."""
        if isinstance(stage, LearnStage):
            return TransformedEnv(self.make_env(), SynergyAction(stage.decoder))
        return self.make_env()

    def evaluator(self, stage: SACStage) -> Callable[[], Evaluation]:
        """Evaluates the stage's present policy on the evaluation seeds."""
        steps = episode_length(self.config.env, self.config.goal) or 1000
        return partial(
            evaluate,
            stage.trained_policy,
            self.evaluation_env(stage),
            solved_steps=self.task.solved_steps,
            episodes=self.config.evaluation.episodes,
            max_steps=steps,
            action_repeat=self.config.action_repeat,
        )

    def _learn(
        self, decoder: SynergyDecoder | None, charged: int, stop: StopOnSignal
    ) -> dict[str, Any]:
        stage = self.learn_stage(decoder)
        if self._reuses and decoder is not None:  # a checkpoint, if there is one, replaces it
            stage.take(self._explored())
        evaluator = self.evaluator(stage)
        last = run_stage(
            stage,
            self.folder,
            stop,
            evaluate=evaluator,
            evaluate_every=self.config.evaluation.every,
            offset=charged,
            **self.loop_options(),
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

    def _explored(self) -> TensorDict:
        """The transitions that stage 1 left."""
        file = self.folder.explored
        if not file.is_file():
            raise FileNotFoundError(
                f"{file} is gone, and stage 2 begins with the transitions in it; start a new run, "
                f"with synergies={self.path} if it shall have the same synergies."
            )
        tensors = safetensors.torch.load(file.read_bytes())
        rows = TensorDict(tensors, tensors["action"].shape[:1]).unflatten_keys(".")
        return rows.to(self.device)

    def _draw_curves(self, charged: int) -> None:
        frames, returns = self.folder.series("learn/eval/return")
        solved = dict(zip(*self.folder.series("learn/eval/solved"), strict=True))
        rows = [
            {"frames": frame, "return": value, "solved": solved.get(frame)}
            for frame, value in zip(frames, returns, strict=True)
        ]
        learning_curves(
            rows,
            self.folder.pictures / "learning_curves.png",
            explore_frames=charged or None,
            title=f"{self.config.env}{self.task.goal_in_words}",
        )

    # Shared ------------------------------------------------------------------------------------

    def _env_maker(self, **options: bool) -> Callable[[], TransformedEnv]:
        """Builds the simulators of one collector; it is sent to other processes as it is."""
        return partial(
            _env_of_a_collector,
            self.config.env,
            num_envs=self.config.collector.num_envs,
            **self._variant,
            **options,
        )

    def _options(self, stage: str) -> dict[str, Any]:
        options = OmegaConf.to_container(self.config[stage], resolve=True)
        options.pop("residual", None)  # an option of the decoder, taken when its bundle is loaded
        collector = OmegaConf.to_container(self.config.collector, resolve=True)
        batched = collector.pop("num_envs") > 1
        collector["collector_class"] = VectorCollector if batched else Collector
        for engine in ("ray", "distributed"):
            collector[engine] = OmegaConf.to_container(self.config[engine], resolve=True)
        compile = self.config.compile
        if compile is None:  # what it takes to begin must pay
            compile = options["frames"] * options["updates_per_frame"] >= 10_000
        return {
            "collector": collector,
            "action_repeat": self.config.action_repeat,
            "compile": compile,
            "scratch": self.path / "buffer",
            **options,
        }

    def loop_options(self) -> dict[str, Any]:
        return {
            "checkpoint_every": self.config.checkpoint.every,
            "keep": self.config.checkpoint.keep,
            "log_every": self.config.log_every,
            "show_progress": self.config.progress,
        }

    def _build_once(self) -> None:
        """Let every part object to its arguments now, not when its stage comes."""
        if self.method is not None:
            self.learn_stage(None)
            if self.method.env_options:  # otherwise the environment is as that of ``spec``
                self.make_env(**self.method.env_options).close()
            return
        if self.config.synergies is None:
            self.explore_stage()
            if self._shows_activations:  # otherwise the environment is as that of ``spec``
                self.make_env(activations=True).close()
        self.learn_stage(self.blank_decoder())

    @property
    def _reuses(self) -> bool:
        return self.config.learn.reuse_exploration and self.config.synergies is None

    @property
    def _shows_activations(self) -> bool:
        return self.config.explore.fit.actions == "activation"

    def _settle_num_synergies(self) -> None:
        """Without a number, take one for the body; refuse more synergies than actuators to ETL."""
        given, actuators = self.config.num_synergies, len(self.actuators)
        if given is None:
            self.config.num_synergies = default_num_synergies(actuators)
            if self.method is None and self.config.num_synergies < MOST_SYNERGIES:
                self.say(
                    f"num_synergies is {self.config.num_synergies}, as {self.config.env} has "
                    f"{actuators} actuators."
                )
        elif self.method is None and given > actuators:
            raise ValueError(
                f"num_synergies is {given} but {self.config.env} has {actuators} actuators; "
                "choose at most that many, or null for a number that fits."
            )

    def _divide_frames(self) -> None:
        """Leave to stage 2 what stage 1 does not take."""
        if self.method is None:
            first = self.config.explore.frames if self.config.synergies is None else 0
        else:
            first = self.method.frames
        left = self.config.frames - first
        if left < 1:
            raise ValueError(
                f"frames is {self.config.frames}, of which {first} go into what comes before "
                "learning; give more in all, or less to that."
            )
        self.config.learn.frames = left

    def _take_bundle(self) -> None:
        """Check the given bundle, and let its own d and its absolute path stand in the config."""
        path = Path(self.config.synergies).resolve()
        _, info = load_bundle(path)
        self.config.synergies = str(path)
        self.config.num_synergies = info.num_synergies
        space = self.spec.full_action_spec_unbatched["action"].space
        check_compatible(info, self.actuators, space.low.tolist(), space.high.tolist())


def _env_of_a_collector(name: str, **kwargs: Any) -> TransformedEnv:
    return TransformedEnv(
        make_env(name, **kwargs, device="cpu"), Compose(RewardSum(), InitTracker())
    )
