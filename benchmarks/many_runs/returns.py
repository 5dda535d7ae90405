"""What each run's rewards are divided by: ``torchrl_etl.modules.ReturnScale``, for many at once."""

from __future__ import annotations

import numpy as np

__all__ = ["ReturnScales"]


class ReturnScales:
    """Of N runs with discount factors ``gammas`` [N]."""

    def __init__(self, gammas: np.ndarray, bound: float) -> None:
        self.gammas, self.bound, self.count = gammas, bound, 0
        self.sums, self.mean, self.squares, self.largest = np.zeros((4, len(gammas)))

    def see(self, reward: np.ndarray, done: np.ndarray) -> None:
        returns = reward + self.gammas * self.sums
        self.sums = np.where(done, 0.0, returns)
        self.count += 1
        shift = returns - self.mean
        self.mean = self.mean + shift / self.count
        self.squares = self.squares + shift * (returns - self.mean)
        self.largest = np.maximum(self.largest, np.abs(returns))

    def scale(self) -> np.ndarray:
        deviation = np.sqrt(self.squares / max(self.count, 1))
        scale = np.maximum(deviation, self.largest / self.bound)
        return np.where(scale > 1e-8, scale, 1.0)
