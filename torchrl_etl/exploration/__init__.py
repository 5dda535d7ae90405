"""Ways for stage 1 to explore, one a file."""

from collections.abc import Callable, Mapping

from torchrl_etl.exploration.directions import DirectionExploration
from torchrl_etl.exploration.exploration import Exploration
from torchrl_etl.exploration.metra import METRAExploration
from torchrl_etl.exploration.metric import MetricExploration

__all__ = [
    "EXPLORATIONS",
    "DirectionExploration",
    "Exploration",
    "METRAExploration",
    "MetricExploration",
]

EXPLORATIONS: Mapping[str, Callable[..., Exploration]] = {
    "metric": MetricExploration,
    "metra": METRAExploration,
}
