"""Losses of both stages as TorchRL loss modules."""

from torchrl_etl.objectives.behavioral_metric import BehavioralMetricLoss
from torchrl_etl.objectives.decoder import DecoderLoss
from torchrl_etl.objectives.gmvae import GMVAELoss
from torchrl_etl.objectives.synergy_sac import SynergySACLoss

__all__ = ["BehavioralMetricLoss", "DecoderLoss", "GMVAELoss", "SynergySACLoss"]
