"""The simulators of a stage, and its seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl.envs import Compose, InitTracker, RewardSum, TransformedEnv
from torchrl.envs.transforms import Transform

from torchrl_etl.envs import make_env

__all__ = ["env_of_a_collector", "stage_seed"]


def stage_seed(seed: int, section: str) -> int:
    """Seed of a stage: even for ``"explore"``, odd for ``"learn"``."""
    return 2 * seed + (section != "explore")


def env_of_a_collector(name: str, transforms: Sequence[Transform], **kwargs: Any) -> TransformedEnv:
    """Build simulators with the transforms that loop and stage need; picklable for workers."""
    own = [transform.clone() for transform in transforms]
    return TransformedEnv(
        make_env(name, **kwargs, device="cpu"), Compose(RewardSum(), InitTracker(), *own)
    )
