"""DEP (Schumacher 2023): at times a controller of muscle lengths replaces the policy."""

from __future__ import annotations

from tensordict.nn import TensorDictSequential

from torchrl_etl.baselines import DEPExploration
from torchrl_etl.checks import check_integer, naming
from torchrl_etl.methods.method import Method
from torchrl_etl.training.stage import Stage

__all__ = ["DEP"]


class DEP(Method):
    """SAC with DEP's controller after the actor.

    Learning starts after the frames in which DEP acts alone, as in the public code: DEP's files in
    ``method/`` set ``learn.learning_starts`` to ``dep_frames``.

    Deviates: the authors' learner is MPO; here it is SAC, as for all methods.

    Options: keyword arguments of :class:`~torchrl_etl.baselines.DEPExploration`, with
    ``dep_frames``, frames of all workers, for ``dep_actions``.
    """

    takes = (
        *("dep_frames", "probability", "intervention_length", "policy_every", "kappa", "tau"),
        *("bias_rate", "time_distance", "s4avg", "normalize"),
    )
    needs = ("dep_frames",)

    def stage(self) -> Stage:
        self.context.seed_everything("learn")
        options = dict(self.options)
        frames = options.pop("dep_frames")
        with naming("method.options"):
            check_integer(0, dep_frames=frames)
            options["dep_actions"] = self.context.actions(frames)
            controller = DEPExploration(self.context.spec.action_spec, **options)
        actor = self.context.actor()
        behavior = TensorDictSequential(self.context.behavior(actor), controller)
        learner = self.context.learner(actor, behavior=behavior)
        return self.context.stage(learner, env_options={"muscle_lengths": True})

    def check(self) -> None:
        super().check()
        self.context.make_env(muscle_lengths=True).close()
