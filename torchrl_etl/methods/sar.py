"""SAR (Berg 2023): synergies from the muscle activity of a play, by PCA and ICA."""

from __future__ import annotations

from typing import Any

import torch
from safetensors.torch import load_file, save
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_etl.baselines import SARDecoder, best_episodes
from torchrl_etl.envs import episode_length
from torchrl_etl.io import write_atomically
from torchrl_etl.learners import Term
from torchrl_etl.methods.method import Method
from torchrl_etl.objectives import DecoderLoss
from torchrl_etl.training.context import Context
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.stage import Stage

__all__ = ["SAR"]


class SAR(Method):
    """Plays with plain SAC and takes synergies from the muscles of the best episodes."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.charged, self.percentile = self.options["frames"], self.options["percentile"]
        self.num_synergies = min(self.options["num_synergies"], context.spec.action_dim)
        self.file = context.folder.path / "sar.safetensors"
        config = context.config
        steps = episode_length(config.env, config.goal) or 0
        self.one_episode_each = steps * config.collector.num_envs
        if self.charged < self.one_episode_each:
            raise ValueError(
                f"method.options.frames is {self.charged}, but {config.collector.num_envs} "
                f"simulators need {self.one_episode_each} for an episode of {steps} steps each, "
                "and SAR takes the best of whole episodes; give more."
            )

    def prepare(self, stop: StopOnSignal) -> dict[str, Any]:
        if not self.file.is_file():
            play = self.play()
            # Episodes begin anew after each checkpoint; some have to come to their end.
            every = max(self.context.config.checkpoint.every, 2 * self.one_episode_each)
            self.context.run_stage(play, stop, checkpoint_every=every)
            found = finished_episodes(play.newest(self.charged))
            actions = best_episodes(**found, percentile=self.percentile)
            write_atomically(self.file, save(self.fit(actions).state_dict()))
        return {}

    def play(self) -> Stage:
        """SAC on the task that remembers which muscle activations came of it, by episode."""
        self.context.seed_everything("learn")
        keep = ("activation", "episode_reward")
        return self.context.stage(
            self.context.learner(),
            env_options={"activations": True},
            name="play",
            frames=self.charged,
            n_steps=1,
            keep=(("collector", "traj_ids"), *(("next", key) for key in keep)),
        )

    def fit(self, actions: Tensor) -> SARDecoder:
        spec = self.context.spec
        return SARDecoder.fit(
            actions,
            self.num_synergies,
            low=spec.low,
            high=spec.high,
            blend=self.options["blend"],
            seed=self.context.config.seed,
        )

    def stage(self) -> Stage:
        spec = self.context.spec
        blank = torch.zeros(1 + self.num_synergies, spec.action_dim)
        decoder = SARDecoder(
            blank[0], blank[1:], low=spec.low, high=spec.high, blend=self.options["blend"]
        )
        if self.file.is_file():
            decoder.load_state_dict(load_file(self.file))
        self.context.seed_everything("learn")
        learner = self.context.learner(
            decoder=decoder.to(self.context.device),
            more=lambda actor: {"terms": [Term(DecoderLoss(decoder), weight=0.0)]},
        )
        return self.context.stage(learner, keep=("synergy",))


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
