"""What the runs of a group share, and what each can have for itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Settings", "Shape"]


@dataclass(frozen=True)
class Shape:
    """What all runs of a group have in common; the defaults are those of ``learner=residual``."""

    body: Literal["residual", "batch_norm"] = "residual"
    blocks: int = 2
    actor: int = 64
    critic: int = 96
    num_critics: int = 2
    bins: int = 101
    bound: float = 5.0
    batch_size: int = 256
    updates: int = 1
    lr: float = 3e-4
    tau: float = 0.01
    unit_rows: bool = False
    normalize_observations: bool = True
    learning_starts: int = 500
    longest: int = 16
    most_steps: int = 1
    share: float = 0.9995
    decoder_lr: float = 3e-5
    anchor: float = 0.1


@dataclass(frozen=True)
class Settings:
    """What a run can have for itself."""

    gamma: float = 0.95
    alpha_init: float = 5e-4
    action_std: float = 0.15
    n_steps: int = 1
    exponent: float = 2.0
    uniform_frames: int = 0
