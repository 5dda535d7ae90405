"""Scaling of rewards by the size of their returns."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_etl.checks import check_real
from torchrl_etl.modules.running_moments import RunningMoments

__all__ = ["ReturnScale", "episode_numbers"]


class ReturnScale(RunningMoments):
    """Divides rewards so that returns have a deviation of about one and stay within a bound.

    Each episode accumulates its past rewards, G_t = r_t + γ G_{t-1}, starting from zero. The scale
    is max(std(G), max|G| / bound) over all data seen.

    Equation: the reward scaling of FlashSAC (2026); its first term is from Engstrom 2020.

    Args:
        gamma (float): discount factor γ in [0, 1).

    Keyword Args:
        bound (float): largest return, in scaled units. Default: 5.

    Raises:
        ValueError: if γ is outside [0, 1) or the bound is not above 0.

    Examples:
        >>> import torch
        >>> from torchrl_etl.modules import ReturnScale
        >>> scale = ReturnScale(gamma=0.5, bound=1.0)
        >>> scale.update(torch.tensor([[4.0, 4.0]]), torch.tensor([[False, False]]))
        >>> scale(torch.tensor([3.0]))  # the largest return so far is 4 + 0.5 * 4
        tensor([0.5000])
    """

    largest: Tensor

    def __init__(self, gamma: float, *, bound: float = 5.0) -> None:
        super().__init__()
        check_real("[0, 1)", gamma=gamma)
        check_real("(0, inf)", bound=bound)
        self.gamma, self.bound = gamma, bound
        self.register_buffer("largest", torch.zeros((), dtype=torch.float64))
        self.reset_episodes()

    def reset_episodes(self) -> None:
        """Start all episodes anew; the scale keeps its statistics."""
        self._sums: dict[int, float] = {}

    @torch.no_grad()
    def update(self, reward: Tensor, done: Tensor, episode: Tensor | None = None) -> None:
        """Update the statistics with a batch.

        Args:
            reward, done (Tensor): of each step, [simulators, time].
            episode (Tensor, optional): episode number of each step, [simulators, time]. A later
                batch with the same number continues its sum, whichever batches come between.
                Default: all batches have the same simulators in the same order.
        """
        reward = reward.to(self.mean)
        if episode is None:
            episode = torch.arange(len(reward)).unsqueeze(1)
        sums = reward.new_tensor([self._sums.pop(name, 0.0) for name in episode[:, 0].tolist()])
        seen = []
        for now, ends in zip(reward.unbind(1), done.unbind(1), strict=True):
            seen.append(now + self.gamma * sums)
            sums = torch.where(ends, 0.0, seen[-1])
        last = zip(episode[:, -1].tolist(), sums.tolist(), done[:, -1].tolist(), strict=True)
        self._sums |= {name: so_far for name, so_far, ends in last if not ends}
        values = torch.stack(seen)
        self.update_moments(values)
        self.largest.copy_(torch.maximum(self.largest, values.abs().max()))

    @property
    def scale(self) -> Tensor:
        """Divisor of the rewards; one before any data."""
        scale = torch.maximum(self.variance.sqrt(), self.largest / self.bound)
        return torch.where(scale > 1e-8, scale, 1.0)

    def forward(self, reward: Tensor) -> Tensor:
        """Rewards of any shape in scaled units."""
        return reward / self.scale.to(reward.dtype)


def episode_numbers(batch: TensorDictBase) -> Tensor:
    """An episode number for each transition [*], unique across workers.

    Workers of one machine share a numbering; each remote worker has its own.
    """
    number = batch["collector", "traj_ids"]
    worker = batch.get(("collector", "worker"), None)
    return number if worker is None else number + (worker << 32)
