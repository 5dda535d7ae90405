"""ETL's rivals as methods of a run: what each finds out beforehand, and the stage that learns."""

from __future__ import annotations

import json
from collections.abc import Mapping
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
from torchrl_etl.envs import episode_length
from torchrl_etl.modules.atomic_files import write_atomically
from torchrl_etl.training.learn import LearnStage
from torchrl_etl.training.loop import StopOnSignal, run_stage
from torchrl_etl.training.rivals import DEPStage, DynSynStage, EMEStage, LatticeStage
from torchrl_etl.training.sac import SACStage
from torchrl_etl.training.stage import Stage

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


class DynSyn(Method):
    """Groups muscles by how their lengths go together while joints are thrown about."""

    takes = ("frames", "amplitude", "group_share", "start_share", "start", "slope", "ceiling")

    def __init__(self, run: Experiment) -> None:
        super().__init__(run)
        self.frames = self.options.pop("frames")
        self.amplitude, self.share = self.options.pop("amplitude"), self.options.pop("group_share")
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
    """Plays with plain SAC and takes synergies from the muscles of the best episodes."""

    takes = ("play_task", "frames", "rollout_frames", "preview_episodes", "percentile")
    takes += ("num_synergies", "blend")

    def __init__(self, run: Experiment) -> None:
        super().__init__(run)
        self.frames, self.percentile = self.options["frames"], self.options["percentile"]
        self.num_synergies = min(self.options["num_synergies"], len(run.actuators))
        self.file = run.path / "sar.safetensors"
        steps = episode_length(run.config.env, run.config.goal) or 0
        self.one_episode_each = steps * run.config.collector.num_envs
        if self.frames < self.one_episode_each:
            raise ValueError(
                f"method.options.frames is {self.frames}, but {run.config.collector.num_envs} "
                f"simulators need {self.one_episode_each} for an episode of {steps} steps each, "
                "and SAR takes the best of whole episodes; give more."
            )

    def prepare(self, stop: StopOnSignal) -> dict[str, Any]:
        if not self.file.is_file():
            options = self.run.learner_options(activations=True)
            play = PlayStage(**options | {"frames": self.frames})
            loop = self.run.loop_options()
            # Episodes begin anew after each checkpoint; some have to come to their end.
            loop["checkpoint_every"] = max(loop["checkpoint_every"], 2 * self.one_episode_each)
            run_stage(play, self.run.folder, stop, **loop)
            rows = play.newest(self.frames)
            actions = best_episodes(**play.finished_episodes(rows), percentile=self.percentile)
            decoder = self.fit(actions)
            write_atomically(self.file, save(decoder.state_dict()))
        return {}

    def fit(self, actions: Tensor) -> SARDecoder:
        space = self.run.spec.full_action_spec_unbatched["action"].space
        return SARDecoder.fit(
            actions,
            self.num_synergies,
            low=space.low,
            high=space.high,
            blend=self.options["blend"],
            seed=self.run.config.seed,
        )

    def stage(self) -> SACStage:
        space = self.run.spec.full_action_spec_unbatched["action"].space
        blank = torch.zeros(1 + self.num_synergies, len(self.run.actuators))
        decoder = SARDecoder(
            blank[0], blank[1:], low=space.low, high=space.high, blend=self.options["blend"]
        )
        if self.file.is_file():
            decoder.load_state_dict(load_file(self.file))
        tuning = {"fine_tuning": "frozen", "decoder_lr": 1e-6, "anchor": 0.0}
        return LearnStage(**self.common(), decoder=decoder, **tuning)


class PlayStage(SACStage):
    """SAC on the task that remembers which muscle activations came of it, by episode.

    They are of single steps: ``sac.n_steps`` is not read.
    """

    name = "play"
    kept = ("observation", "action", ("collector", "traj_ids"))

    spanned = Stage.spanned  # of single steps

    def transitions(self, batch: TensorDictBase) -> TensorDictBase:
        kept = super().transitions(batch)
        kept["next"].update(batch["next"].select("activation", "episode_reward"))
        return kept

    @staticmethod
    def finished_episodes(rows: TensorDictBase) -> dict[str, Tensor]:
        """Activations [N, n], returns [N] and episodes [N] of the steps of whole episodes."""
        episodes = rows["collector", "traj_ids"].reshape(-1)
        ends = rows["next", "done"].reshape(-1)
        returns = torch.full((int(episodes.max()) + 1,), torch.nan)
        returns[episodes[ends]] = rows["next", "episode_reward"].reshape(-1)[ends]
        whole = returns[episodes].isfinite()
        return {
            "actions": rows["next", "activation"][whole],
            "returns": returns[episodes][whole],
            "episodes": episodes[whole],
        }


METHODS: Mapping[str, type[Method]] = {
    "sac": Method,
    "lattice": Lattice,
    "dep": DEP,
    "dynsyn": DynSyn,
    "eme": EME,
    "sar": SAR,
}
