"""What each run's rewards are divided by: ``torchrl_etl.modules.ReturnScale``, for many at once."""

from __future__ import annotations

import numpy as np
import torch

from torchrl_etl.modules.running_moments import RunningMoments

__all__ = ["ReturnScales"]


class ReturnScales(RunningMoments):
    """Of N runs with discount factors ``gammas`` [N]."""

    def __init__(self, gammas: np.ndarray, bound: float) -> None:
        super().__init__((len(gammas),))
        self.gammas, self.bound = gammas, bound
        self.sums, self.largest = np.zeros((2, len(gammas)))

    def step(self, reward: np.ndarray, done: np.ndarray) -> None:
        """See a step of every run [N]."""
        returns = reward + self.gammas * self.sums
        self.sums = np.where(done, 0.0, returns)
        self.see(torch.from_numpy(returns))
        self.largest = np.maximum(self.largest, np.abs(returns))

    @property
    def scale(self) -> np.ndarray:
        scale = np.maximum(self.variance.sqrt().numpy(), self.largest / self.bound)
        return np.where(scale > 1e-8, scale, 1.0)
