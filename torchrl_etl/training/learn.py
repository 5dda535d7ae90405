"""Stage 2: learn the task in synergy space while the decoder adapts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.objectives import DecoderLoss, SynergySACLoss
from torchrl_etl.training.sac import SACStage

__all__ = ["LearnStage"]

FineTuning = Literal["frozen", "reconstruction", "critic"]


class LearnStage(SACStage):
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
        fine_tuning (str): "critic", "reconstruction" or "frozen".
        decoder_lr (float): learning rate of the decoder.
        anchor (float): weight of Eq. 10 under "critic".
        **sac_stage: see :class:`~torchrl_etl.training.sac.SACStage`.
    """

    kept = ("observation", "synergy", "action")

    def __init__(
        self,
        make_env: Callable[[], EnvBase],
        spec: EnvBase,
        decoder: SynergyDecoder,
        *,
        fine_tuning: FineTuning,
        decoder_lr: float,
        anchor: float,
        **sac_stage: Any,
    ) -> None:
        self.decoder = decoder.to(sac_stage["device"])
        self.fine_tuning, self.decoder_lr = fine_tuning, decoder_lr
        self.anchor = {"frozen": 0.0, "reconstruction": 1.0, "critic": anchor}[fine_tuning]
        super().__init__(make_env, spec, **sac_stage)
        self.decoder_loss = DecoderLoss(decoder)

    def emitted(self, muscles: Bounded) -> tuple[Bounded, str]:
        return self.decoder.synergy_spec, "synergy"

    def policy_of(self, actor: TensorDictModuleBase) -> TensorDictModuleBase:
        # The decoder acts as a part of the policy: its weights then reach every worker with the
        # actor's. What it decodes is recorded as it happens.
        return TensorDictSequential(actor, self.decoder)

    def make_loss(self, critic: TensorDictModuleBase, **options: Any) -> SynergySACLoss:
        through = self.fine_tuning == "critic"
        return SynergySACLoss(self.actor, critic, self.decoder, train_decoder=through, **options)

    def groups(self, lr: float) -> list[tuple[list[Tensor], float]]:
        decoder = list(self.decoder.parameters())
        known = {id(parameter) for parameter in decoder}
        others = [parameter for parameter in self.sac.parameters() if id(parameter) not in known]
        if self.fine_tuning == "frozen":
            return [(others, lr)]
        return [(others, lr), (decoder, self.decoder_lr)]

    def losses(self, batch: TensorDictBase) -> tuple[Tensor, TensorDictBase]:
        loss, scalars = super().losses(batch)
        reconstruction = self.decoder_loss(batch)["loss_decoder"]
        if self.anchor:
            loss = loss + self.anchor * reconstruction
        return loss, scalars.set("loss_decoder", reconstruction)

    def take(self, rows: TensorDictBase) -> None:
        """Learn from transitions of another policy too, as often as from frames of one's own.

        The critics value executed actions, so it does not matter which policy chose them. Their
        ``synergy`` has d entries; where there is a residual, theirs is zero.
        """
        missing = self.decoder.synergy_dim - rows["synergy"].shape[-1]
        rows = rows.copy().set("synergy", nn.functional.pad(rows["synergy"], (0, missing)))
        if self.norm is not None:
            self.norm.see(rows["observation"])
        self.buffer.extend(self.transitions(rows))
        self.earn(len(rows))

    def acting(self) -> dict[str, Any]:
        return {**super().acting(), "decoder": self.decoder}
