"""TorchRL transforms: an episode's direction, the bonus for following it, synergies as actions."""

from torchrl_etl.transforms.direction import DirectionPrimer
from torchrl_etl.transforms.intrinsic_reward import IntrinsicReward
from torchrl_etl.transforms.redraw_direction import RedrawDirection
from torchrl_etl.transforms.synergy_action import SynergyAction

__all__ = ["DirectionPrimer", "IntrinsicReward", "RedrawDirection", "SynergyAction"]
