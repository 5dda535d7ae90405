"""Lattice (Chiappa 2023): noise on the last hidden features, so that actuators move together."""

from __future__ import annotations

from functools import partial
from typing import Any

from torchrl_etl.baselines import LatticeNoise, make_lattice_actor
from torchrl_etl.methods.method import Method
from torchrl_etl.training.stage import Stage

__all__ = ["Lattice"]


class Lattice(Method):
    """SAC with Lattice's actor, whose noise is its own: ``learn.noise`` is not read.

    Options: ``freq``, steps between draws of the noise matrices where they depend on the state,
    and keyword arguments of :func:`~torchrl_etl.baselines.make_lattice_actor`.
    """

    takes = ("state_dependent", "freq", "log_std_init", "log_std_bounds", "alpha", "std_reg")

    def actor(self) -> dict[str, Any]:
        return {"kind": "lattice", **{k: v for k, v in self.options.items() if k != "freq"}}

    def stage(self) -> Stage:
        options = self.actor()
        del options["kind"]
        freq, held = self.options["freq"], options["state_dependent"]
        self.context.seed_everything("learn")
        learner = self.context.learner(
            make_actor=partial(make_lattice_actor, **options),
            make_behavior=partial(LatticeNoise, freq=freq) if held else lambda actor: actor,
        )
        return self.context.stage(learner)
