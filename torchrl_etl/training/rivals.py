"""The stages of ETL's rivals: SAC as the control runs it, with one idea of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor

from torchrl_etl.baselines import (
    DEPExploration,
    EMEBonus,
    EMELoss,
    LatticeNoise,
    RewardEnsemble,
    make_dynsyn_actor,
    make_lattice_actor,
    set_frames,
)
from torchrl_etl.modules import StateEncoder
from torchrl_etl.objectives import FusedSoftUpdate, LeanSACLoss
from torchrl_etl.training.sac import SACStage
from torchrl_etl.training.stage import Stage, entropy_target

__all__ = ["DEPStage", "DynSynStage", "EMEStage", "LatticeStage"]


class LatticeStage(SACStage):
    """Lattice (Chiappa 2023): noise on the last hidden features, so that actuators move together.

    Its noise is its own: ``sac.noise`` is not read.

    Keyword Args:
        lattice (mapping): ``state_dependent``, ``freq`` (steps between draws of the noise
            matrices, where it is), and further arguments of
            :func:`~torchrl_etl.baselines.make_lattice_actor`.
        **sac_stage: see :class:`~torchrl_etl.training.sac.SACStage`.
    """

    def __init__(self, *args: Any, lattice: Mapping[str, Any], **sac_stage: Any) -> None:
        self._lattice = dict(lattice)
        self._freq = self._lattice.pop("freq")
        super().__init__(*args, **sac_stage)

    def build_actor(self, inputs: Any, spec: Bounded, **options: Any) -> ProbabilisticActor:
        return make_lattice_actor(inputs, spec, **options, **self._lattice)

    def exploring(self, noise: str) -> TensorDictModuleBase:
        if self._lattice["state_dependent"]:
            return LatticeNoise(self.actor, freq=self._freq)
        return self.actor


class DEPStage(SACStage):
    """DEP (Schumacher 2023): now and then a controller of muscle lengths acts instead.

    Learning starts when DEP has acted alone, as in the public code.

    Deviates: its learner is MPO; here it is SAC, the same as everyone's.

    Keyword Args:
        dep (mapping): keyword arguments of :class:`~torchrl_etl.baselines.DEPExploration`, but
            ``dep_frames`` counts frames of the run, those of all workers.
        **sac_stage: see :class:`~torchrl_etl.training.sac.SACStage`; ``make_env`` must give
            ``muscle_length``.
    """

    def __init__(
        self, *args: Any, dep: Mapping[str, Any], learning_starts: int, **sac_stage: Any
    ) -> None:
        self._dep = dep
        learning_starts = max(learning_starts, dep["dep_frames"])
        super().__init__(*args, learning_starts=learning_starts, **sac_stage)

    def exploring(self, noise: str) -> TensorDictModuleBase:
        alone = self.actions(self._dep["dep_frames"])
        self.controller = DEPExploration(self.action_spec, **{**self._dep, "dep_frames": alone})
        return TensorDictSequential(super().exploring(noise), self.controller)

    def restart_collection(self) -> None:
        # A resumed run goes on where it was; the controller counts its actions.
        self.controller.frames = self.actions(self.frames)
        super().restart_collection()


class DynSynStage(SACStage):
    """DynSyn (He 2024): muscles that move alike share one action.

    Its actor's distribution is its own: ``sac.noise`` is not read.

    Keyword Args:
        groups (sequence of int): the group of each muscle.
        dynsyn (mapping): further arguments of :func:`~torchrl_etl.baselines.make_dynsyn_actor`;
            with ``start_share`` in place of ``start`` and ``slope``, weights deviate from that
            share of the stage's frames on, linearly up to their ceiling at the last frame.
        **sac_stage: see :class:`~torchrl_etl.training.sac.SACStage`.
    """

    def __init__(
        self, *args: Any, groups: Sequence[int], dynsyn: Mapping[str, Any], **sac_stage: Any
    ) -> None:
        self._groups, self._dynsyn = list(groups), dict(dynsyn)
        if "start_share" in self._dynsyn:
            start = self._dynsyn.pop("start_share") * sac_stage["frames"]
            slope = self._dynsyn["ceiling"] / (sac_stage["frames"] - start)
            self._dynsyn |= {"start": start, "slope": slope}
        super().__init__(*args, **sac_stage)

    def build_actor(self, inputs: Any, spec: Bounded, **options: Any) -> ProbabilisticActor:
        return make_dynsyn_actor(inputs, spec, self._groups, **options, **self._dynsyn)

    def exploring(self, noise: str) -> TensorDictModuleBase:
        return self.actor

    def target_entropy(self, action_std: float | None) -> float | str:
        # The actor's log-probability counts one dimension a group.
        first = [self._groups.index(group) for group in sorted(set(self._groups))]
        if action_std is None:
            return -float(len(first))
        return entropy_target(self.action_spec[first], action_std)

    def seen(self, batch: TensorDictBase) -> TensorDictBase:
        set_frames(self.actor, self.frames)
        return super().seen(batch)


class EMEStage(SACStage):
    """EME (Wang 2024): a bonus for steps that are long in a metric of reward and policy.

    Its bonus and its metric are of single steps: ``sac.n_steps`` is not read.

    Its metric has the discount of the learner, ``sac.gamma``.

    Deviates: built on SAC from the paper's equations; see :class:`~torchrl_etl.baselines.EMELoss`.

    Keyword Args:
        eme (mapping): ``embedding_dim`` and ``hidden`` of the encoder, ``ensemble`` (its size),
            ``lr``, ``tau`` (of the target encoder), ``weight``, ``normalize`` and ``max_scale``
            of :class:`~torchrl_etl.baselines.EMEBonus`.
        **sac_stage: see :class:`~torchrl_etl.training.sac.SACStage`.
    """

    reward = "total_reward"

    def __init__(
        self, *args: Any, eme: Mapping[str, Any], sac: Mapping[str, Any], **sac_stage: Any
    ) -> None:
        self._eme, self._gamma = eme, sac["gamma"]
        super().__init__(*args, sac=sac, **sac_stage)
        options = {key: eme[key] for key in ("weight", "max_scale", "normalize")}
        self.bonus = EMEBonus(self.encoder, self.ensemble, **options)
        self.buffer.append_transform(self.bonus)
        self.targets = [*self.targets, FusedSoftUpdate(self.metric, tau=eme["tau"])]

    def make_loss(self, critic: TensorDictModuleBase, **options: Any) -> LeanSACLoss:
        observation_dim, action_dim = self.observation_dim, self.action_spec.shape[-1]
        hidden = self._eme["hidden"]
        self.encoder = StateEncoder(observation_dim, self._eme["embedding_dim"], hidden=hidden)
        self.ensemble = RewardEnsemble(
            observation_dim, action_dim, self._eme["ensemble"], hidden=hidden
        )
        self.metric = EMELoss(
            self.encoder.to(self.device),
            self.ensemble.to(self.device),
            self.actor,
            gamma=self._gamma,
        ).to(self.device)
        return super().make_loss(critic, **options)

    def groups(self, lr: float) -> list[tuple[list[Tensor], float]]:
        return [*super().groups(lr), (list(self.metric.parameters()), self._eme["lr"])]

    spanned = Stage.spanned  # of single steps

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        loss, scalars = super().losses(batch)
        metric = self.metric(batch)
        scalars.update(metric).set("bonus", batch["next", "intrinsic_reward"].mean())
        return loss + metric["loss_metric"] + metric["loss_reward_ensemble"], scalars

    def parts(self) -> dict[str, Any]:
        return {**super().parts(), "metric": self.metric, "bonus": self.bonus}
