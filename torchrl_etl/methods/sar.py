"""SAR (Berg 2023): synergies from muscle activity of a play phase, by PCA and ICA."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_etl.analysis import variance_accounted_for
from torchrl_etl.baselines import best_episodes
from torchrl_etl.checks import check_integer, check_real, naming
from torchrl_etl.envs import EnvironmentSpec, resolve_task
from torchrl_etl.io import write_atomically
from torchrl_etl.learners import Term
from torchrl_etl.methods.method import Method
from torchrl_etl.modules import SARDecoder
from torchrl_etl.modules.return_scale import episode_numbers
from torchrl_etl.objectives import DecoderLoss
from torchrl_etl.synergies import SARSynergies
from torchrl_etl.training.context import Context
from torchrl_etl.training.evaluation import longest_episode
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.run_folder import facts
from torchrl_etl.training.stage import Stage
from torchrl_etl.training.work import Work

__all__ = ["SAR"]


class SAR(Method):
    """Trains a play policy with plain SAC, then extracts synergies from its best rollouts.

    Deviates: frames of rollouts also count toward the budget, so rollouts are few; the first
    episodes, at most half, are the preview from whose returns the percentile is computed.

    The policy acts through the published map, which clamps actions to the bounds. The run folder
    also gets a bundle with the components of ``synergies=sar``
    (:class:`~torchrl_etl.synergies.SARSynergies`), for the viewer and for ETL's stage 2. This run
    does not read it.

    Options: ``play_task`` (another task of the same body), ``frames`` of play, ``rollout_frames``
    after play, ``preview_episodes`` and the ``percentile`` of their returns, ``num_synergies``, and
    ``blend`` of :class:`~torchrl_etl.modules.SARDecoder`.
    """

    takes = (
        *("play_task", "frames", "rollout_frames", "preview_episodes", "percentile"),
        *("num_synergies", "blend"),
    )
    needs = takes

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        config = context.config
        self.rollout_frames, self.task = self.options["rollout_frames"], self.options["play_task"]
        with naming("method.options"):
            whole = ("frames", "rollout_frames", "num_synergies")
            check_integer(1, **{name: self.options[name] for name in whole})
            check_integer(0, preview_episodes=self.options["preview_episodes"])
            check_real("[0, 100]", percentile=self.options["percentile"])
        self.charged_frames = self.options["frames"] + self.rollout_frames
        self.num_synergies = min(self.options["num_synergies"], context.spec.action_dim)
        self.blend = self.resolve_for_body(self.options["blend"])
        played, self.play_spec = context.task, context.spec
        if self.task is not None:
            played |= {"name": self.task, "goal": None, "success_key": None}
            with closing(context.make_env(**played)) as env:
                self.play_spec = EnvironmentSpec.of(env, context.device)
            if self.play_spec.actuators != context.spec.actuators:
                raise ValueError(
                    f"method.options.play_task is {self.task}, but its actuators are not those of "
                    f"{config.env}; choose a task of the same body."
                )
        self.played = resolve_task(played["name"], played["goal"]).env_id
        steps, simulators = longest_episode(played, unlimited=0), config.collector.num_envs
        if config.collector.kind != "single":  # which has no workers
            simulators *= config.collector.num_workers
        needed = steps * max(2, simulators)
        if self.rollout_frames < needed and not self.file.is_file():
            raise ValueError(
                f"method.options.rollout_frames is {self.rollout_frames}, but {simulators} "
                f"simulators need {needed} for two whole episodes of {steps} steps, and SAR takes "
                "the best of whole episodes; raise it."
            )

    @property
    def file(self) -> Path:
        return self.context.folder.path / "sar.safetensors"

    def prepare(self, stop: StopOnSignal) -> Work[dict[str, Any]]:
        if not self.file.is_file():
            play = self.play_stage()
            yield from self.context.run_stage(play, stop)
            actions = self.best((yield from rollouts(play, self.rollout_frames, stop.check)))
            model = self.fit(actions)
            decoder = model.blended_decoder(actions, blend=self.blend)
            self._save_bundle(model, actions)
            # Written last, since its presence marks this step as complete.
            write_atomically(self.file, save(decoder.state_dict()))
        return {}

    def play_stage(self) -> Stage:
        """Build the play stage."""
        self.context.seed_everything("learn")
        return self.context.stage(
            self.context.learner(spec=self.play_spec),
            task=self.task,
            env_options={"activations": True},
            name="play",
            frames=self.options["frames"],
        )

    def best(self, rows: TensorDictBase) -> Tensor:
        """Activations of episodes whose returns exceed the percentile of the preview episodes."""
        episode, returns = episode_returns(rows)
        whole = returns.isfinite().nonzero().squeeze(-1)
        previewed = min(self.options["preview_episodes"], len(whole) // 2)
        preview, fresh = whole[:previewed], whole[previewed:]
        best = best_episodes(
            returns[fresh],
            percentile=self.options["percentile"],
            preview=returns[preview] if previewed else None,
        )
        return rows["next", "activation"][torch.isin(episode, fresh[best])]

    def fit(self, actions: Tensor) -> SARSynergies:
        spec, seed = self.context.spec, self.context.config.seed
        model = SARSynergies(spec.low, spec.high, self.num_synergies, seed=seed)
        model.most_rows = len(actions)  # of the best episodes, all count
        model.fit(actions)
        return model

    def _save_bundle(self, model: SARSynergies, actions: Tensor) -> None:
        vaf = variance_accounted_for(actions, model.reconstruct(actions))
        model.save(
            self.context.folder.synergies,
            actions,
            task=self.played,
            actuators=self.context.spec.actuators,
            facts={"vaf": vaf, "frames": self.charged_frames, "seed": model.seed, **facts()},
        )

    def decoder(self) -> SARDecoder | None:
        if not self.file.is_file():
            return None
        decoder = self._placeholder()
        decoder.load_state_dict(load_file(self.file))
        return decoder

    def _placeholder(self) -> SARDecoder:
        """A decoder of the right sizes, for use before play."""
        spec = self.context.spec
        sizes, bounds = (self.num_synergies, spec.action_dim), {"low": spec.low, "high": spec.high}
        with naming("method.options"):
            return SARDecoder(*sizes, **bounds, blend=self.blend)

    def stage(self) -> Stage:
        decoder = self.decoder()
        if decoder is None:
            decoder = self._placeholder()
        self.context.seed_everything("learn")
        decoder = decoder.to(self.context.device)
        term = Term(DecoderLoss(decoder), weight=0.0)
        learner = self.context.learner(decoder=decoder, terms=[term])
        return self.context.stage(learner, keep=("synergy",))


def rollouts(stage: Stage, frames: int, check: Callable[[], None]) -> Work[TensorDictBase]:
    """Collect transitions [N] of new episodes with a stage's behavior policy, without updates.

    Args:
        stage (Stage): stage whose behavior policy acts; closed afterwards.
        frames (int): minimum number of frames.
        check (callable): called before each batch; may raise to stop.
    """
    torch.manual_seed(stage.seed)  # the same whether or not the run was resumed
    kept = [("next", key) for key in ("activation", "episode_reward", "done")]
    rows: list[TensorDictBase] = []
    try:
        stage.start_collection()
        yield None
        stage.restart_collection()
        while stage.action_repeat * sum(map(len, rows)) < frames:
            check()
            stage.request()
            yield None
            batch = stage.batches.next().to(stage.device)
            rows.append(batch.select(*kept).set("episode", episode_numbers(batch)).reshape(-1))
    finally:
        stage.close()
    return torch.cat(rows)


def episode_returns(rows: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Index [N] of each row's episode, and returns [E], NaN for an episode that has no end."""
    numbers, episode = rows["episode"].unique(return_inverse=True)
    so_far, ends = rows["next", "episode_reward"].reshape(-1), rows["next", "done"].reshape(-1)
    returns = so_far.new_full(numbers.shape, torch.nan)
    returns[episode[ends]] = so_far[ends]
    return episode, returns
