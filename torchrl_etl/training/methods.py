"""ETL's rivals as methods of a run: what each finds out beforehand, and the stage that learns."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from safetensors.torch import load_file, save
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_etl.baselines import (
    SARDecoder,
    best_episodes,
    group_muscles,
    record_muscle_lengths,
)
from torchrl_etl.envs import actuator_names, episode_length, has_free_root, make_env
from torchrl_etl.modules.atomic_files import write_atomically
from torchrl_etl.training.learn import LearnStage
from torchrl_etl.training.loop import StopOnSignal, run_stage
from torchrl_etl.training.rivals import DEPStage, DynSynStage, EMEStage, LatticeStage
from torchrl_etl.training.sac import SACStage, episodes

if TYPE_CHECKING:
    from torchrl_etl.training.experiment import Experiment

__all__ = ["METHODS", "Method"]


class Method:
    """Plain SAC, the control, and what the others fill in.

    Args:
        run (Experiment): whose configuration, environment and folder are used.

    Attributes:
        frames (int): that finding out takes; they are charged.
        env_options (mapping): what the environment must also give.
    """

    frames = 0
    env_options: ClassVar[Mapping[str, bool]] = {}
    takes: ClassVar[tuple[str, ...]] = ()
    """Names of the method's own options."""

    def __init__(self, run: Experiment) -> None:
        self.run = run
        self.options = dict(run.config.method.get("options", {}))
        for name in self.options:
            if name not in self.takes:
                method = run.config.method.name
                raise ValueError(
                    f"method.options.{name} is none of the options of method={method} "
                    f"({', '.join(self.takes) or 'it has none'}); settings of the learner, such as "
                    "the discount, are those of learn, such as learn.sac.gamma."
                )

    def prepare(self, stop: StopOnSignal) -> dict[str, Any]:
        """Find out what the stage needs and leave it in the run folder; facts for the summary.

        What is there already is not done again.
        """
        return {}

    def stage(self) -> SACStage:
        """The stage that learns the task, before its first frame."""
        return SACStage(**self.common())

    def common(self) -> dict[str, Any]:
        """Arguments of every such stage."""
        return self.run.learner_options(**self.env_options)


class Lattice(Method):
    takes = ("state_dependent", "freq", "log_std_init", "log_std_bounds", "alpha", "std_reg")

    def stage(self) -> SACStage:
        return LatticeStage(**self.common(), lattice=self.options)


class DEP(Method):
    env_options: ClassVar[Mapping[str, bool]] = {"muscle_lengths": True}
    takes = ("dep_frames", "probability", "intervention_length", "policy_every", "kappa", "tau")
    takes += ("bias_rate", "time_distance", "s4avg", "normalize")

    def stage(self) -> SACStage:
        return DEPStage(**self.common(), dep=self.options)


class EME(Method):
    takes = ("embedding_dim", "hidden", "ensemble", "lr", "tau", "weight", "normalize", "max_scale")

    def stage(self) -> SACStage:
        return EMEStage(**self.common(), eme=self.options)


def of_the_body(option: float | Mapping[str, float], run: Experiment) -> float:
    """An option as given, or the one for this body of the two for ``legs`` and for ``hands``.

    Legs are what stands free: a body whose root floats.
    """
    if not isinstance(option, Mapping):
        return option
    return option["legs" if has_free_root(run.spec) else "hands"]


class DynSyn(Method):
    """Groups muscles by how their lengths go together while joints are thrown about."""

    takes = ("frames", "amplitude", "group_share", "start_share", "start", "slope", "ceiling")

    def __init__(self, run: Experiment) -> None:
        super().__init__(run)
        self.frames = self.options.pop("frames")
        self.amplitude = of_the_body(self.options.pop("amplitude"), run)
        self.share = of_the_body(self.options.pop("group_share"), run)
        self.file = run.path / "muscle_groups.json"

    def prepare(self, stop: StopOnSignal) -> dict[str, Any]:
        if not self.file.is_file():
            count = max(1, round(self.share * len(self.run.actuators)))
            seed = self.run.config.seed
            lengths = record_muscle_lengths(
                self.run.make_env(action_repeat=1),  # a recorded step is a frame
                self.frames,
                amplitude=self.amplitude,
                seed=2**30 + seed,
            )
            groups = group_muscles(lengths, count, seed=seed).tolist()
            write_atomically(self.file, json.dumps(groups))
        return {"groups": self.groups}

    @property
    def groups(self) -> list[int]:
        if self.file.is_file():
            return json.loads(self.file.read_text(encoding="utf-8"))
        return list(range(len(self.run.actuators)))  # only to see that a stage can be built

    def stage(self) -> SACStage:
        return DynSynStage(**self.common(), groups=self.groups, dynsyn=self.options)


class SAR(Method):
    """Plays with plain SAC and takes synergies from the muscles of the best of fresh episodes.

    Deviates: the frames of the rollouts are charged too, so they are few; the first of them,
    half at most, are the preview of whose returns the percentile is taken.
    """

    takes = ("play_task", "frames", "rollout_frames", "preview_episodes", "percentile")
    takes += ("num_synergies", "blend")

    def __init__(self, run: Experiment) -> None:
        super().__init__(run)
        self.rollout_frames = self.options["rollout_frames"]
        self.frames = self.options["frames"] + self.rollout_frames
        self.num_synergies = min(self.options["num_synergies"], len(run.actuators))
        self.blend = of_the_body(self.options["blend"], run)
        self.file = run.path / "sar.safetensors"
        self.task = self.options["play_task"]
        self.spec = run.spec
        if self.task is not None:
            self.spec = make_env(self.task, action_repeat=run.config.action_repeat)
            if actuator_names(self.spec) != run.actuators:
                raise ValueError(
                    f"method.options.play_task is {self.task}, whose actuators are not those of "
                    f"{run.config.env}; play on a task of the same body."
                )
        name, goal = (self.task, None) if self.task else (run.config.env, run.config.goal)
        steps, simulators = episode_length(name, goal) or 0, run.config.collector.num_envs
        if self.rollout_frames < (needed := steps * max(2, simulators)):
            raise ValueError(
                f"method.options.rollout_frames is {self.rollout_frames}, but {simulators} "
                f"simulators need {needed} for two whole episodes of {steps} steps, and SAR takes "
                "the best of whole episodes; give more."
            )

    def prepare(self, stop: StopOnSignal) -> dict[str, Any]:
        if not self.file.is_file():
            play = self.play_stage()
            run_stage(play, self.run.folder, stop, **self.run.loop_options())
            decoder = self.fit(self.best(play.rollouts(self.rollout_frames, stop.check)))
            write_atomically(self.file, save(decoder.state_dict()))
        return {}

    def play_stage(self) -> PlayStage:
        """The stage whose policy plays, before its first frame."""
        options = self.run.learner_options(self.task, activations=True)
        return PlayStage(**options | {"spec": self.spec, "frames": self.options["frames"]})

    def best(self, rows: TensorDictBase) -> Tensor:
        """Activations of the episodes above the percentile of the preview, the first of them."""
        found = PlayStage.finished_episodes(rows)
        numbers = found["episodes"].unique()
        preview = numbers[: min(self.options["preview_episodes"], len(numbers) // 2)]
        returns = [found["returns"][found["episodes"] == number][:1] for number in preview]
        fresh = ~torch.isin(found["episodes"], preview)
        return best_episodes(
            **{key: value[fresh] for key, value in found.items()},
            percentile=self.options["percentile"],
            preview=torch.cat(returns) if returns else None,
        )

    def fit(self, actions: Tensor) -> SARDecoder:
        space = self.run.spec.full_action_spec_unbatched["action"].space
        return SARDecoder.fit(
            actions,
            self.num_synergies,
            low=space.low,
            high=space.high,
            blend=self.blend,
            seed=self.run.config.seed,
        )

    def stage(self) -> SACStage:
        space = self.run.spec.full_action_spec_unbatched["action"].space
        blank = torch.zeros(1 + self.num_synergies, len(self.run.actuators))
        decoder = SARDecoder(blank[0], blank[1:], low=space.low, high=space.high, blend=self.blend)
        if self.file.is_file():
            decoder.load_state_dict(load_file(self.file))
        tuning = {"fine_tuning": "frozen", "decoder_lr": 1e-6, "anchor": 0.0}
        return LearnStage(**self.common(), decoder=decoder, **tuning)


class PlayStage(SACStage):
    """SAC on the task to play with, and fresh rollouts of the policy that it has trained."""

    name = "play"

    def rollouts(self, frames: int, check: Callable[[], None]) -> TensorDictBase:
        """Steps [N] of new episodes of the policy, acting as it explores, without learning.

        Args:
            frames (int): at least so many are collected.
            check (callable): called before each batch; it may raise.
        """
        torch.manual_seed(self.seed)  # the same whether or not the run was resumed
        kept = [("next", key) for key in ("activation", "episode_reward", "done")]
        rows: list[TensorDictBase] = []
        try:
            self.restart_collection()
            while self.action_repeat * sum(map(len, rows)) < frames:
                check()
                batch = self.batches.next().to(self.device)
                steps = batch.select(*kept).set("episode", episodes(batch))
                rows.append(steps.reshape(-1))
        finally:
            self.close()
        return torch.cat(rows)

    @staticmethod
    def finished_episodes(rows: TensorDictBase) -> dict[str, Tensor]:
        """Activations [N, n], returns [N] and episodes [N] of the steps of whole episodes."""
        numbers, episode = rows["episode"].unique(return_inverse=True)
        ends = rows["next", "done"].reshape(-1)
        returns = torch.full(numbers.shape, torch.nan)
        returns[episode[ends]] = rows["next", "episode_reward"].reshape(-1)[ends]
        whole = returns[episode].isfinite()
        return {
            "actions": rows["next", "activation"][whole],
            "returns": returns[episode][whole],
            "episodes": episode[whole],
        }


METHODS: Mapping[str, type[Method]] = {
    "sac": Method,
    "lattice": Lattice,
    "dep": DEP,
    "dynsyn": DynSyn,
    "eme": EME,
    "sar": SAR,
}
