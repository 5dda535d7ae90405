"""DynSyn (He 2024): muscles that move alike share one action."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

from torchrl_etl.baselines import group_muscles, make_dynsyn_actor, record_muscle_lengths
from torchrl_etl.checks import check_integer, check_real, naming
from torchrl_etl.io import read_json, write_atomically
from torchrl_etl.methods.method import Method
from torchrl_etl.training.context import Context
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.stage import Stage
from torchrl_etl.training.work import Work

__all__ = ["DynSyn"]


class DynSyn(Method):
    """SAC with one action per group of muscles, grouped by their lengths under random joint motion.

    The actor has its own distribution, which includes the exploration noise.

    Options: ``frames`` of the recording, which count toward the budget; ``amplitude`` of its
    joint velocities; ``group_share``, groups per muscle; and keyword arguments of
    :func:`~torchrl_etl.baselines.make_dynsyn_actor`. ``amplitude`` and ``group_share`` may have one
    value for ``legs`` and one for ``hands``. ``start_share`` replaces ``start`` and ``slope``:
    weights deviate after that share of the stage's frames, linearly up to ``ceiling`` at the last.
    """

    fixed_settings = (("learn.noise.kind", "independent", "the actor has its own noise"),)
    takes = ("frames", "amplitude", "group_share", "start_share", "start", "slope", "ceiling")
    needs = ("frames", "amplitude", "group_share")

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        deviation = dict(self.options)
        self.charged_frames = deviation.pop("frames")
        self.amplitude = self.resolve_for_body(deviation.pop("amplitude"))
        self.share = self.resolve_for_body(deviation.pop("group_share"))
        self.deviation = deviation
        with naming("method.options"):
            check_integer(1, frames=self.charged_frames)
            check_real("(0, inf)", amplitude=self.amplitude)
            check_real("(0, 1]", group_share=self.share)
            if "start_share" in deviation:
                check_real("[0, 1)", start_share=deviation["start_share"])
                if "ceiling" not in deviation or {"start", "slope"} & {*deviation}:
                    raise ValueError("start_share needs ceiling, and replaces start and slope.")

    def prepare(self, stop: StopOnSignal) -> Work[dict[str, Any]]:
        yield from ()  # a generator, see Work; this one never pauses
        if not self.file.is_file():
            write_atomically(self.file, json.dumps(self.found_groups(stop)))
        return {"groups": self.groups}

    def found_groups(self, stop: StopOnSignal) -> list[int]:
        """The group of each muscle, from muscle lengths recorded under random joint motion."""
        seed, muscles = self.context.config.seed, len(self.context.spec.actuators)
        # Without action repeat, one recorded step is one frame.
        with closing(self.context.make_env(action_repeat=1)) as env:
            lengths = record_muscle_lengths(
                env,
                self.charged_frames,
                amplitude=self.amplitude,
                seed=2**30 + seed,
                on_step=stop.check,
            )
        return group_muscles(lengths, max(1, round(self.share * muscles)), seed=seed).tolist()

    @property
    def file(self) -> Path:
        return self.context.folder.path / "muscle_groups.json"

    @property
    def groups(self) -> list[int]:
        if self.file.is_file():
            cure = "move it away to group the muscles again"
            return read_json(self.file, list, OSError, cure)
        return list(range(len(self.context.spec.actuators)))  # a placeholder

    def actor(self) -> dict[str, Any]:
        return {"kind": "dynsyn", "groups": self.groups}

    def stage(self) -> Stage:
        spec, groups, deviation = self.context.spec.action_spec, self.groups, dict(self.deviation)
        if "start_share" in deviation:
            frames = self.context.config.learn.frames
            start = deviation.pop("start_share") * frames
            deviation |= {"start": start, "slope": deviation["ceiling"] / (frames - start)}
        with naming("method.options"):  # the actor checks them
            make_dynsyn_actor({"observation": 1}, spec, groups, **deviation)
        self.context.seed_everything("learn")
        actor = self.context.actor(make=make_dynsyn_actor, groups=groups, **deviation)
        # The actor's log-probability has one dimension per group.
        first = [groups.index(group) for group in sorted(set(groups))]
        loss = self.context.loss(actor, entropy_spec=spec[first])
        return self.context.stage(self.context.learner(actor, loss=loss))
