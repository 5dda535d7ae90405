"""The episodes from whose muscle activity SAR takes its synergies (Berg 2023)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_etl.checks import check_real

__all__ = ["best_episodes"]


def best_episodes(
    actions: Tensor,
    returns: Tensor,
    *,
    episodes: Tensor | None = None,
    percentile: float = 80.0,
    preview: Tensor | None = None,
) -> Tensor:
    """Actions of the episodes whose return is above a percentile of all returns.

    If there is none, the episodes with the highest return are used.

    Args:
        actions (Tensor): one row for each step of each episode [N, n].
        returns (Tensor): return of each row's episode [N].

    Keyword Args:
        episodes (Tensor, optional): number of each row's episode [N], so that each episode counts
            once in the percentile. Default: ``None``, each counts by its number of steps, which is
            the same for episodes of equal length.
        percentile (float): in [0, 100]. Default: 80.
        preview (Tensor, optional): returns of earlier episodes [M], one each, used for the
            percentile. Default: ``None``, the percentile of these episodes.

    Returns:
        Tensor: the rows of the best episodes, in their order.

    Raises:
        ValueError: if the shapes do not match, the percentile is out of its range, or rows of one
            episode have different returns.

    Examples:
        >>> import torch
        >>> returns = torch.tensor([5.0, 1.0, 2.0, 3.0, 4.0]).repeat_interleave(2)
        >>> best_episodes(torch.arange(10.0).unsqueeze(-1), returns)
        tensor([[0.],
                [1.]])
        >>> best_episodes(torch.arange(10.0).unsqueeze(-1), returns, preview=torch.tensor([3.5]))
        tensor([[0.],
                [1.],
                [8.],
                [9.]])
    """
    lengths = [len(actions), *(x.numel() for x in (returns, episodes) if x is not None)]
    if actions.ndim != 2 or len(set(lengths)) > 1 or not len(actions):
        raise ValueError(
            f"actions has shape {list(actions.shape)}, returns {list(returns.shape)} and episodes "
            f"{None if episodes is None else list(episodes.shape)}; they must be [N, actuators], "
            "[N] and [N], with N of 1 or more."
        )
    check_real("[0, 100]", percentile=percentile)
    returns = returns.reshape(-1).double()
    counted = returns
    if episodes is not None:
        names, row_to_name = episodes.reshape(-1).unique(return_inverse=True)
        counted = returns.new_zeros(len(names)).scatter_(0, row_to_name, returns)
        if not torch.equal(counted[row_to_name], returns):
            raise ValueError(
                "returns differ within an episode; give each row the return of its whole episode."
            )
    if preview is not None:
        counted = preview
    best = returns > float(np.percentile(counted.cpu().numpy(), percentile))
    return actions[best if best.any() else returns == returns.max()]
