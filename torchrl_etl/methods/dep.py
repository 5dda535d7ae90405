"""DEP (Schumacher 2023): now and then a controller of muscle lengths acts instead of the policy."""

from __future__ import annotations

from tensordict.nn import TensorDictSequential

from torchrl_etl.baselines import DEPExploration
from torchrl_etl.methods.method import Method
from torchrl_etl.training.stage import Stage

__all__ = ["DEP"]


class DEP(Method):
    """SAC whose behavior policy is followed by DEP's controller.

    Deviates: its authors' learner is MPO; here it is SAC, the same as everyone's.

    Options: keyword arguments of :class:`~torchrl_etl.baselines.DEPExploration`.
    """

    env_options = {"muscle_lengths": True}  # noqa: RUF012

    def stage(self) -> Stage:
        self.context.seed_everything("learn")
        repeat = self.context.config.action_repeat
        controller = DEPExploration(self.context.spec.action_spec, **self.options)

        def restart(frames: int) -> None:
            # A resumed run goes on where it was; the controller counts its actions.
            controller.frames = frames // repeat

        learner = self.context.learner(
            make_behavior=lambda actor: TensorDictSequential(actor, controller),
            more=lambda actor: {"on_restart": restart},
        )
        return self.context.stage(learner, env_options=self.env_options)

    def check(self) -> None:
        super().check()
        self.context.make_env(**self.env_options).close()
