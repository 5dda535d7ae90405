"""EME (Wang 2024): a bonus for transitions that are long in a metric of reward and policy."""

from __future__ import annotations

from torchrl_etl.baselines import EMEBonus, EMELoss, RewardEnsemble
from torchrl_etl.checks import naming
from torchrl_etl.learners import Term
from torchrl_etl.methods.method import Method
from torchrl_etl.modules import StateEncoder
from torchrl_etl.training.stage import Stage

__all__ = ["EME"]


class EME(Method):
    """SAC on reward plus bonus, with the metric trained alongside.

    Bonus and metric are defined on single steps, so critics use one-step targets. The metric uses
    the learner's discount.

    Deviates: built on SAC from the paper's equations; see :class:`~torchrl_etl.baselines.EMELoss`.

    Options: ``embedding_dim`` and ``hidden`` of the encoder, ``ensemble`` (its size), ``lr``,
    ``tau`` (EMA rate of the target encoder), ``weight``, ``normalize`` and ``max_scale`` of
    :class:`~torchrl_etl.baselines.EMEBonus`.
    """

    fixed_settings = (("learn.n_steps", 1, "bonus and metric are of single steps"),)
    takes = ("embedding_dim", "hidden", "ensemble", "lr", "tau", "weight", "normalize", "max_scale")
    needs = takes

    def stage(self) -> Stage:
        spec, options = self.context.spec, self.options
        sizes, device = (spec.observation_dim, spec.action_dim), spec.action_spec.device
        self.context.seed_everything("learn")
        with naming("method.options"):
            encoder = StateEncoder(sizes[0], options["embedding_dim"], hidden=options["hidden"])
            ensemble = RewardEnsemble(*sizes, options["ensemble"], hidden=options["hidden"])
            scale = {key: options[key] for key in ("weight", "normalize", "max_scale")}
            bonus = EMEBonus(encoder.to(device), ensemble.to(device), **scale)
        actor = self.context.actor()
        with naming("learn.sac"):
            gamma = self.context.config.learn.sac.gamma
            loss = EMELoss(encoder, ensemble, actor, gamma=gamma).to(device)
        with naming("method.options"):
            term = Term(loss, lr=options["lr"], tau=options["tau"])
        learner = self.context.learner(
            actor, terms=[term], transforms=[bonus], reward="total_reward"
        )
        return self.context.stage(learner)
