"""Losses of both stages as TorchRL loss modules."""

from torchrl_etl.objectives.behavioral_metric import BehavioralMetricLoss
from torchrl_etl.objectives.decoder import DecoderLoss
from torchrl_etl.objectives.factory import entropy_target, make_sac_loss
from torchrl_etl.objectives.gmvae import GMVAELoss
from torchrl_etl.objectives.metra import METRALoss
from torchrl_etl.objectives.sac import LeanSACLoss
from torchrl_etl.objectives.soft_update import FusedSoftUpdate
from torchrl_etl.objectives.synergy_sac import SynergySACLoss

__all__ = [
    "BehavioralMetricLoss",
    "DecoderLoss",
    "FusedSoftUpdate",
    "GMVAELoss",
    "LeanSACLoss",
    "METRALoss",
    "SynergySACLoss",
    "entropy_target",
    "make_sac_loss",
]
