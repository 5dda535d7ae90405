"""TorchRL transforms: episode directions, exploration bonuses, and synergies as actions."""

from torchrl_etl.transforms.direction import DirectionPrimer
from torchrl_etl.transforms.intrinsic_reward import IntrinsicReward
from torchrl_etl.transforms.latent_action import LatentAction
from torchrl_etl.transforms.redraw_direction import RedrawDirection
from torchrl_etl.transforms.rnd_bonus import RNDBonus
from torchrl_etl.transforms.scaled_bonus import ScaledBonus
from torchrl_etl.transforms.synergy_action import SynergyAction

__all__ = [
    "DirectionPrimer",
    "IntrinsicReward",
    "LatentAction",
    "RNDBonus",
    "RedrawDirection",
    "ScaledBonus",
    "SynergyAction",
]
