"""Stage 1: explore along latent directions and condense the muscle actions into synergies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_etl.analysis import direction_alignment
from torchrl_etl.modules import (
    GMVAE,
    GaussianDynamics,
    StateEncoder,
    SynergyDecoder,
    make_actor,
    make_critic,
)
from torchrl_etl.objectives import (
    BehavioralMetricLoss,
    FusedSoftUpdate,
    GMVAELoss,
    LeanSACLoss,
    METRALoss,
)
from torchrl_etl.training.stage import (
    Stage,
    entropy_target,
    gradient_step,
    make_optimizer,
    ready_for_training,
)
from torchrl_etl.transforms import DirectionPrimer, IntrinsicReward, RedrawDirection

__all__ = ["ExploreStage"]

GMVAEActions = Literal["policy", "mean", "sampled", "activation"]


class ExploreStage(Stage):
    """Algorithm 1, phase 1: SAC on the intrinsic reward, the metric and the GMVAE side by side.

    Every update draws one batch. Its bonus is computed as it is drawn, with the state encoder as
    it then is; SAC learns on the bonus (and the task's reward, if that has a weight), the encoder
    on the behavioral metric with the task's own reward, and the GMVAE on the batch's actions.

    Deviates: the recipes pay stage 1 with the task's reward too (``bonus.extrinsic_weight=4``);
    0 is Algorithm 1. Batches get directions drawn anew (``redraw=1``), without which some thousand
    frames lead nowhere in particular; 0 is the print. The GMVAE sees the mean actions of the
    policy as it is (``actions="policy"``) or was when it acted (``"mean"``), since actions sampled
    from a maximum-entropy policy are nearly white noise that few synergies cannot explain;
    ``"sampled"`` is the print. After the last frame the GMVAE is trained on for ``final_updates``
    (Algorithm 1 stops with the last frame: 0).

    Args:
        make_base_env (callable): environment to which the direction is added.
        spec (EnvBase): any instance of that environment, to read sizes and bounds from.

    Keyword Args:
        num_synergies (int): d.
        actor, critic, encoder, direction, bonus, metric, gmvae, sac (mapping): keyword arguments of
            :func:`~torchrl_etl.modules.make_actor`, :func:`~torchrl_etl.modules.make_critic`,
            :class:`~torchrl_etl.modules.StateEncoder`,
            :class:`~torchrl_etl.transforms.DirectionPrimer`,
            :class:`~torchrl_etl.transforms.IntrinsicReward`,
            :class:`~torchrl_etl.objectives.BehavioralMetricLoss`,
            :class:`~torchrl_etl.modules.GMVAE`, and of SAC (``gamma``, ``tau``, ``lr``,
            ``alpha_init``, ``action_std``,
            ``loss_function``).
        redraw (float): ``share`` of :class:`~torchrl_etl.transforms.RedrawDirection`.
        fit (mapping): how the GMVAE is trained: ``actions`` ("policy", "mean", "sampled" or
            "activation"), ``best_share`` (share of each batch, by task reward, that it sees),
            ``lr``, ``kl_weight``, ``component_kl_weight``, ``final_updates``.
        representation (str): "metric" trains φ on the behavioral metric, "metra" on the bonus under
            a constraint; ``metra`` has :class:`~torchrl_etl.objectives.METRALoss`'s arguments.
        encoder_lr (float), encoder_tau (float): of φ and of its target.
        **stage: see :class:`~torchrl_etl.training.stage.Stage`.
    """

    name = "explore"

    def __init__(
        self,
        make_base_env: Callable[[], TransformedEnv],
        spec: EnvBase,
        *,
        num_synergies: int,
        actor: Mapping[str, Any],
        critic: Mapping[str, Any],
        encoder: Mapping[str, Any],
        encoder_lr: float,
        encoder_tau: float,
        direction: Mapping[str, Any],
        redraw: float,
        bonus: Mapping[str, Any],
        representation: Literal["metric", "metra"],
        metric: Mapping[str, Any],
        metra: Mapping[str, Any],
        gmvae: Mapping[str, Any],
        fit: Mapping[str, Any],
        sac: Mapping[str, Any],
        device: torch.device,
        **stage: Any,
    ) -> None:
        torch.manual_seed(stage["seed"])
        action_spec = spec.full_action_spec_unbatched["action"]
        observation_dim = spec.observation_spec["observation"].shape[-1]
        inputs = {"observation": observation_dim, "direction": encoder["embedding_dim"]}

        policy = make_actor(inputs, action_spec, **actor).to(device)
        value = make_critic({**inputs, "action": action_spec.shape[-1]}, **critic).to(device)
        self.encoder = StateEncoder(observation_dim, **encoder).to(device)
        self.gmvae = GMVAE.from_spec(action_spec, num_synergies, **gmvae).to(device)

        make_primer = partial(DirectionPrimer, encoder["embedding_dim"], **direction)
        self.redraw = RedrawDirection(make_primer(), share=redraw)
        super().__init__(
            lambda: make_base_env().append_transform(make_primer()),
            policy,
            device=device,
            **stage,
        )
        self.bonus = IntrinsicReward(self.encoder, **bonus)
        self.buffer.append_transform(self.redraw).append_transform(self.bonus)

        self.sac = LeanSACLoss(
            policy,
            value,
            action_spec=action_spec,
            target_entropy=entropy_target(action_spec, sac["action_std"]),
            alpha_init=sac["alpha_init"],
            loss_function=sac["loss_function"],
        ).to(device)
        self.sac.set_keys(reward="intrinsic_reward")
        self.targets = [ready_for_training(self.sac, gamma=sac["gamma"], tau=sac["tau"])]

        if representation == "metra":
            self.metric = METRALoss(self.encoder, **metra).to(device)
        else:
            dynamics = None
            if metric.get("divergence") == "gaussian":
                dynamics = GaussianDynamics(self.encoder.embedding_dim).to(device)
            self.metric = BehavioralMetricLoss(self.encoder, dynamics, **metric).to(device)
            if metric["delay_encoder"]:
                self.targets.append(FusedSoftUpdate(self.metric, tau=encoder_tau))

        fit = dict(fit)
        self.fit_actions: GMVAEActions = fit.pop("actions")
        self.best_share, self.final_updates = fit.pop("best_share"), fit.pop("final_updates")
        self.optimizer = make_optimizer(
            device,
            (self.sac.parameters(), sac["lr"]),
            (self.metric.parameters(), encoder_lr),
            (self.gmvae.parameters(), fit.pop("lr")),
        )
        self.gmvae_loss = GMVAELoss(self.gmvae, **fit)

    def transitions(self, batch: TensorDictBase) -> TensorDictBase:
        kept = batch.select("observation", "direction", "action", ("next", "observation"))
        kept["next"].update(batch["next"].select("direction", "done", "terminated"))
        kept["next", "reward"] = self.reward_scale * batch["next", "reward"]
        match self.fit_actions:
            case "mean":
                shown = self.policy.build_dist_from_params(batch).deterministic_sample
                kept["shown_action"] = shown
            case "activation":
                kept["shown_action"] = batch["next", "activation"]
        return kept

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        out = self.sac(batch)
        out.update(self.metric(batch)).update(self.gmvae_loss(self._best(batch)))
        loss = sum(value for key, value in out.items() if key.startswith("loss_"))
        # ("next", "intrinsic_reward") appeared as the batch was drawn, from today's φ.
        return loss, out.set("intrinsic_reward", batch["next", "intrinsic_reward"].mean())

    @torch.no_grad()
    def _shown(self, batch: TensorDictBase) -> Tensor:
        """The actions [N, n] of a batch that the GMVAE sees."""
        match self.fit_actions:
            case "policy":
                inputs = batch.select(*self.policy.in_keys)
                return self.policy.get_dist(inputs).deterministic_sample
            case "sampled":
                return batch["action"]
        return batch["shown_action"]

    def _best(self, batch: TensorDictBase) -> TensorDictBase:
        """The better-rewarded share of a batch, as what the GMVAE sees."""
        actions = self._shown(batch)
        if self.best_share < 1:
            count = max(1, round(self.best_share * len(actions)))
            actions = actions[batch["next", "reward"].squeeze(-1).topk(count).indices]
        return TensorDict({"action": actions}, actions.shape[:1])

    def finish(self, on_update: Callable[[], None] = lambda: None) -> SynergyDecoder:
        """Train the GMVAE on for ``final_updates``; returns the decoder for stage 2.

        Args:
            on_update (callable): called before every update; may raise to stop.
        """
        for _ in range(self.final_updates):
            on_update()
            loss = self.gmvae_loss(self._best(self.buffer.sample()))["loss_gmvae"]
            gradient_step(self.optimizer, loss)
        return SynergyDecoder.from_gmvae(self.gmvae, self.actions())

    def explored(self, decoder: SynergyDecoder) -> TensorDictBase:
        """All kept transitions as stage 2 has them: the task's reward, and each executed action
        with the coefficients that come nearest to it.
        """
        rows = self.newest(self.budget)
        kept = rows.select("observation", "action", ("next", "observation"))
        kept["next"].update(rows["next"].select("done", "terminated"))
        kept["next", "reward"] = rows["next", "reward"] / self.reward_scale
        return kept.set("synergy", decoder.encode(self.gmvae, rows["action"]))

    def actions(self, count: int = 20_000) -> Tensor:
        """Up to ``count`` of the latest actions shown to the GMVAE, [N, n]."""
        return self._shown(self.redraw(self.newest(count)).to(self.device))

    @torch.no_grad()
    def alignment(self, count: int = 20_000) -> float:
        """:func:`~torchrl_etl.analysis.direction_alignment` of the latest states."""
        rows = self.newest(count)
        reached = self.encoder(rows["next", "observation"].to(self.device))
        return direction_alignment(reached, rows["direction"])

    def parts(self) -> dict[str, Any]:
        return {
            "sac": self.sac,
            "metric": self.metric,
            "gmvae": self.gmvae,
            "optimizer": self.optimizer,
            "bonus": self.bonus,
        }
