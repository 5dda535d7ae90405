"""Lattice (Chiappa 2023): noise on the last hidden features, so that actuators move together."""

from __future__ import annotations

from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase

from torchrl_etl.baselines import LatticeNoise, make_lattice_actor
from torchrl_etl.checks import naming
from torchrl_etl.methods.method import Method
from torchrl_etl.training.context import Context
from torchrl_etl.training.stage import Stage

__all__ = ["Lattice"]


class Lattice(Method):
    """SAC with Lattice's actor, which has its own exploration noise.

    Options: ``freq``, steps between draws of the noise matrices if they are state-dependent, and
    keyword arguments of :func:`~torchrl_etl.baselines.make_lattice_actor`.
    """

    fixed_settings = (("learn.noise.kind", "independent", "the actor has its own noise"),)
    takes = ("state_dependent", "freq", "log_std_init", "log_std_bounds", "alpha", "std_reg")

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.actor_options = {k: v for k, v in self.options.items() if k != "freq"}
        with naming("method.options"):  # actor and behavior check their own arguments
            actor = make_lattice_actor(
                {"observation": 1}, context.spec.action_spec, **self.actor_options
            )
            self.behavior(actor)

    def actor(self) -> dict[str, Any]:
        return {"kind": "lattice", **self.actor_options}

    def behavior(self, actor: ProbabilisticTensorDictSequential) -> TensorDictModuleBase:
        """The behavior policy; state-dependent noise holds its matrices for ``freq`` steps."""
        if not self.options.get("state_dependent", False):
            return actor
        return LatticeNoise(actor, **{k: v for k, v in self.options.items() if k == "freq"})

    def stage(self) -> Stage:
        self.context.seed_everything("learn")
        actor = self.context.actor(make=make_lattice_actor, **self.actor_options)
        return self.context.stage(self.context.learner(actor, behavior=self.behavior(actor)))
