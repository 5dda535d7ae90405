"""Exploration methods of stage 1, one per file."""

from collections.abc import Mapping

from torchrl_etl.exploration.directions import DirectionExploration
from torchrl_etl.exploration.exploration import Exploration
from torchrl_etl.exploration.metra import METRAExploration
from torchrl_etl.exploration.metric import MetricExploration
from torchrl_etl.exploration.noise import LastingNoise, NoiseExploration
from torchrl_etl.exploration.rnd import RNDExploration

__all__ = [
    "EXPLORATIONS",
    "DirectionExploration",
    "Exploration",
    "LastingNoise",
    "METRAExploration",
    "MetricExploration",
    "NoiseExploration",
    "RNDExploration",
]

EXPLORATIONS: Mapping[str, type[Exploration]] = {
    "metric": MetricExploration,
    "metra": METRAExploration,
    "rnd": RNDExploration,
    "noise": NoiseExploration,
}
"""Exploration classes by name; ``"my_module:MyExploration"`` names a custom one."""
