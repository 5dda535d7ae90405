"""Stage 2: learn the task in synergy space while the decoder adapts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_etl.modules import SynergyDecoder, make_actor, make_critic
from torchrl_etl.objectives import DecoderLoss, SynergySACLoss
from torchrl_etl.training.stage import Stage, entropy_target, make_optimizer, ready_for_training

__all__ = ["LearnStage"]

FineTuning = Literal["frozen", "reconstruction", "critic"]


class LearnStage(Stage):
    """Algorithm 1, phase 2: SAC on synergy coefficients, the decoder mapping them to muscles.

    The decoder is fine-tuned in one of three modes: ``"critic"`` (default: the actor loss runs
    through the decoder, Eq. 10 is the anchor that keeps it from drifting), ``"reconstruction"``
    (Eq. 10 alone, as printed) or ``"frozen"``.

    Deviates: see :class:`~torchrl_etl.objectives.SynergySACLoss` and
    :class:`~torchrl_etl.objectives.DecoderLoss`.

    Args:
        make_env (callable): environment to collect from.
        spec (EnvBase): any instance of that environment, to read sizes and bounds from.
        decoder (SynergyDecoder): from stage 1 or a bundle; it is trained in place.

    Keyword Args:
        network, sac (mapping): as in :class:`~torchrl_etl.training.explore.ExploreStage`.
        fine_tuning (str): "critic", "reconstruction" or "frozen".
        decoder_lr (float): learning rate of the decoder.
        anchor (float): weight of Eq. 10 under "critic".
        **stage: see :class:`~torchrl_etl.training.stage.Stage`.
    """

    name = "learn"

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        spec: EnvBase,
        decoder: SynergyDecoder,
        *,
        network: Mapping[str, Any],
        sac: Mapping[str, Any],
        fine_tuning: FineTuning,
        decoder_lr: float,
        anchor: float,
        device: torch.device,
        **stage: Any,
    ) -> None:
        torch.manual_seed(stage["seed"])
        observation_dim = spec.observation_spec["observation"].shape[-1]
        self.decoder = decoder.to(device)
        self.actor = actor = make_actor(
            {"observation": observation_dim}, decoder.synergy_spec, out_key="synergy", **network
        ).to(device)
        critic = make_critic(
            {"observation": observation_dim, "action": decoder.action_dim}, **network
        ).to(device)

        # The decoder acts as a part of the policy: its weights then reach every worker with the
        # actor's. What it decodes is recorded as it happens.
        super().__init__(make_env, TensorDictSequential(actor, decoder), device=device, **stage)
        self.sac = SynergySACLoss(
            actor,
            critic,
            decoder,
            train_decoder=fine_tuning == "critic",
            action_spec=decoder.synergy_spec,
            target_entropy=entropy_target(decoder.synergy_spec, sac["action_std"]),
            alpha_init=sac["alpha_init"],
        ).to(device)
        self.targets = [ready_for_training(self.sac, gamma=sac["gamma"], tau=sac["tau"])]

        self.decoder_loss = DecoderLoss(decoder)
        self.anchor = {"frozen": 0.0, "reconstruction": 1.0, "critic": anchor}[fine_tuning]
        tuned = [] if fine_tuning == "frozen" else list(decoder.parameters())
        others = _without(self.sac.parameters(), decoder.parameters())
        self.optimizer = make_optimizer(device, (others, sac["lr"]), (tuned, decoder_lr))

    def transitions(self, batch: TensorDictBase) -> TensorDictBase:
        kept = batch.select("observation", "synergy", "action", ("next", "observation"))
        kept["next"].update(batch["next"].select("done", "terminated"))
        kept["next", "reward"] = self.reward_scale * batch["next", "reward"]
        return kept

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        sac = self.sac(batch)
        reconstruction = self.decoder_loss(batch)["loss_decoder"]
        loss = sac["loss_actor"] + sac["loss_qvalue"] + sac["loss_alpha"]
        if self.anchor:
            loss = loss + self.anchor * reconstruction
        return loss, sac.set("loss_decoder", reconstruction)

    def parts(self) -> dict[str, Any]:
        return {
            "sac": self.sac,
            "optimizer": self.optimizer,
            "actor": self.actor,
            "decoder": self.decoder,
        }


def _without(parameters: Any, excluded: Any) -> list[torch.nn.Parameter]:
    known = {id(parameter) for parameter in excluded}
    return [parameter for parameter in parameters if id(parameter) not in known]
