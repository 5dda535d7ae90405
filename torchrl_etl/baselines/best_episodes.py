"""The episodes from whose muscle activity SAR takes its synergies (Berg 2023)."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from torchrl_etl.checks import check_real

__all__ = ["best_episodes"]


def best_episodes(
    returns: Tensor, *, percentile: float = 80.0, preview: Tensor | None = None
) -> Tensor:
    """Mask of the episodes whose return is above a percentile of all returns.

    If there is none, the episodes with the highest return are used.

    Args:
        returns (Tensor): return of each episode [E], with E of 1 or more.

    Keyword Args:
        percentile (float): in [0, 100]. Default: 80.
        preview (Tensor, optional): returns of earlier episodes [M], used for the percentile.
            Default: ``None``, the percentile of these episodes.

    Returns:
        Tensor: mask of the best episodes [E].

    Raises:
        ValueError: if there is no episode, or the percentile is out of its range.

    Examples:
        >>> import torch
        >>> best_episodes(torch.tensor([5.0, 1.0, 2.0, 3.0, 4.0]))
        tensor([ True, False, False, False, False])
        >>> best_episodes(torch.tensor([5.0, 1.0, 2.0, 3.0, 4.0]), preview=torch.tensor([3.5]))
        tensor([ True, False, False, False,  True])
    """
    if returns.ndim != 1 or not len(returns):
        raise ValueError(
            f"returns has shape {list(returns.shape)}; it must be [E], the return of each episode, "
            "with E of 1 or more."
        )
    check_real("[0, 100]", percentile=percentile)
    returns = returns.double()
    counted = returns if preview is None else preview
    best = returns > float(np.percentile(counted.cpu().numpy(), percentile))
    return best if best.any() else returns == returns.max()
