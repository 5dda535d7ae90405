"""Baselines of ETL, as parts that other TorchRL code can use."""

from torchrl_etl.baselines.best_episodes import best_episodes
from torchrl_etl.baselines.dep import DEPController, DEPExploration
from torchrl_etl.baselines.dynsyn import GroupedTanhNormal, make_dynsyn_actor
from torchrl_etl.baselines.eme import EMELoss
from torchrl_etl.baselines.eme_bonus import EMEBonus
from torchrl_etl.baselines.lattice import LatticeNormal, make_lattice_actor
from torchrl_etl.baselines.lattice_noise import LatticeNoise
from torchrl_etl.baselines.muscle_groups import group_muscles, record_muscle_lengths
from torchrl_etl.baselines.reward_ensemble import RewardEnsemble

__all__ = [
    "DEPController",
    "DEPExploration",
    "EMEBonus",
    "EMELoss",
    "GroupedTanhNormal",
    "LatticeNoise",
    "LatticeNormal",
    "RewardEnsemble",
    "best_episodes",
    "group_muscles",
    "make_dynsyn_actor",
    "make_lattice_actor",
    "record_muscle_lengths",
]
