"""SAR: synergies as an affine basis, from muscle activations of a short run (Berg 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_etl.checks import check_integer, check_real
from torchrl_etl.modules import SynergyMap
from torchrl_etl.modules.recorded_actions import as_actions, as_bounds
from torchrl_etl.synergies.sar import independent_components

__all__ = ["SARDecoder", "best_episodes"]


class _BlendedBasis(nn.Module):
    """z ∈ [-1, 1]^d → mean + z·basis, blended with a raw action and clamped to the bounds."""

    def __init__(
        self, mean: Tensor, basis: Tensor, low: Tensor, high: Tensor, blend: float
    ) -> None:
        super().__init__()
        self.blend = blend
        for name, value in (("mean", mean), ("basis", basis), ("low", low), ("high", high)):
            self.register_buffer(name, value)

    def forward(self, synergy: Tensor) -> Tensor:
        if self.blend == 1:
            return (self.mean + synergy @ self.basis).clamp(self.low, self.high)
        synergy, raw = synergy.split(list(self.basis.shape), -1)
        raw = self.low + (raw + 1) / 2 * (self.high - self.low)
        action = self.blend * (self.mean + synergy @ self.basis) + (1 - self.blend) * raw
        return action.clamp(self.low, self.high)


class SARDecoder(SynergyMap):
    """Decodes synergy coefficients into muscle actions by a fixed affine map.

    It can replace a :class:`~torchrl_etl.modules.SynergyDecoder`, but has only buffers and no
    parameters. Make one with :meth:`fit`.

    With a ``blend`` φ below 1 the synergy key has d + n entries. The last n are a raw action in
    [-1, 1]^n.

    Equation: a = φ·inverse(z) + (1 - φ)·a_raw, clamped to the bounds, where inverse undoes the
    scaling, the independent and the principal components.

    Deviates: the paper's critics value the coefficients and the raw action; under
    :class:`~torchrl_etl.objectives.SynergySACLoss` they value the executed action. See also
    :meth:`fit`.

    Args:
        mean (Tensor): the action at z = 0 [n].
        basis (Tensor): change of the action per unit of each coefficient [d, n].

    Keyword Args:
        low, high (float, sequence of float or Tensor): action bounds, one or [n].
            Default: -1 and 1.
        blend (float): φ in (0, 1]; the paper uses 0.66 for hands and 1 (synergies only) for legs.
            Default: 0.66.
        in_keys (sequence of NestedKey): the coefficients. Default: ``("synergy",)``.
        out_keys (sequence of NestedKey): the action. Default: ``("action",)``.

    Keys:
        reads ``synergy`` [*, d+n] (or [*, d] with ``blend=1``) in [-1, 1]; writes ``action`` [*, n]
        in [low, high].

    Raises:
        ValueError: if φ is outside (0, 1], or shapes or bounds do not fit.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> activity = torch.randn(200, 3) @ torch.randn(3, 39)  # three sources, 39 muscles
        >>> decoder = SARDecoder.fit(activity.tanh(), num_synergies=3, blend=0.66)
        >>> decoder.synergy_spec.shape
        torch.Size([42])
        >>> decoder(TensorDict({"synergy": torch.zeros(2, 42)}, [2]))["action"].shape
        torch.Size([2, 39])
    """

    def __init__(
        self,
        mean: Tensor,
        basis: Tensor,
        *,
        low: float | Sequence[float] | Tensor = -1.0,
        high: float | Sequence[float] | Tensor = 1.0,
        blend: float = 0.66,
        in_keys: Sequence[NestedKey] = ("synergy",),
        out_keys: Sequence[NestedKey] = ("action",),
    ) -> None:
        if mean.ndim != 1 or basis.ndim != 2 or basis.shape[1] != len(mean):
            raise ValueError(
                f"mean has shape {list(mean.shape)} and basis {list(basis.shape)}; they must be "
                "[actuators] and [synergies, actuators]."
            )
        _check_blend(blend)
        low, high = _bounds(low, high, mean)
        super().__init__(
            _BlendedBasis(mean.detach().clone(), basis.detach().clone(), low, high, blend),
            in_keys=list(in_keys),
            out_keys=list(out_keys),
        )
        self.num_synergies, self.action_dim = basis.shape
        self.residual = 1.0 - blend  # the share of an actuator's range that the raw action has

    @classmethod
    def fit(
        cls,
        actions: Tensor,
        num_synergies: int = 20,
        *,
        low: float | Sequence[float] | Tensor = -1.0,
        high: float | Sequence[float] | Tensor = 1.0,
        blend: float = 0.66,
        seed: int = 0,
        **keys: Any,
    ) -> SARDecoder:
        """Find the synergies of recorded muscle activity.

        Principal components, then independent ones, then a scaling of each coefficient to [-1, 1].
        All three are affine and are combined into one map.

        Deviates: the public code is fitted on activations in [0, 1] but outputs actions, which pass
        MyoSuite's sigmoid once more. Here ``actions`` are activations mapped back through the
        sigmoid to action units, a = 1/2 + ln(x / (1 - x)) / 5. The entry ``activation`` of
        ``make_env(..., activations=True)`` already is in these units.

        Args:
            actions (Tensor): muscle activity [N, n] in action units, such as from
                :func:`best_episodes`.
            num_synergies (int): number d of synergies. Default: 20.

        Keyword Args:
            low, high, blend: see the class.
            seed (int): seed of the search for independent components. Default: 0.
            in_keys, out_keys: see the class.

        Returns:
            SARDecoder: in the dtype and on the device of the actions.

        Raises:
            ValueError: if there are too few actions or dimensions in which they vary, or they are
                invalid (see :func:`~torchrl_etl.modules.recorded_actions.as_actions`).
        """
        _check_blend(blend)
        check_integer(1, num_synergies=num_synergies)
        actions = _varying(actions, num_synergies, low, high)
        rows = actions.cpu().double().numpy()
        mean, basis = map(torch.as_tensor, independent_components(rows, num_synergies, seed=seed))
        coefficients = (torch.as_tensor(rows) - mean) @ basis.pinverse()
        least, most = coefficients.aminmax(dim=0)
        mean, basis = mean + (least + most) / 2 @ basis, ((most - least) / 2)[:, None] * basis
        return cls(mean.to(actions), basis.to(actions), low=low, high=high, blend=blend, **keys)

    def log_slope(self, synergy: Tensor) -> Tensor:
        """Zero [*]: inside the bounds the raw action moves the action equally far everywhere.

        A clamped action does not move at all, but its noise still counts as entropy, as in the
        public code.
        """
        return synergy.new_zeros(synergy.shape[:-1])

    @torch.no_grad()
    def encode(self, action: Tensor | np.ndarray) -> Tensor:
        """Coefficients [*, d] of actions [*, n] by least squares, clamped to [-1, 1]."""
        action = as_actions(action, low=self.low, high=self.high)
        middle = (self.low + self.high) / 2
        synergies = (action - self.residual * middle) / self.module.blend - self.module.mean
        return (synergies @ self.module.basis.pinverse()).clamp(-1, 1)

    @property
    def low(self) -> Tensor:
        return self.module.low

    @property
    def high(self) -> Tensor:
        return self.module.high


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


def _check_blend(blend: float) -> None:
    if not 0.0 < blend <= 1.0:
        raise ValueError(
            f"blend is {blend}; it must be in (0, 1], the share of the synergies in an action (in "
            "the paper 0.66 for hands and 1 for legs)."
        )


def _bounds(low: Any, high: Any, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Both bounds as [n], in the dtype and on the device of ``mean``."""
    low, high = as_bounds(low, high, len(mean))
    return low.to(mean), high.to(mean)


def _varying(actions: Tensor, num_synergies: int, low: Any, high: Any) -> Tensor:
    """The actions [N, n], checked to vary enough for ``num_synergies`` synergies."""
    real = torch.promote_types(actions.dtype, torch.float32)
    low, high = _bounds(low, high, actions.new_zeros(actions.shape[-1:], dtype=real))
    actions = as_actions(actions, low=low, high=high, min_rows=num_synergies + 1)
    centered = actions.double() - actions.double().mean(0)
    variances = torch.linalg.eigvalsh(centered.T @ centered)
    varying = int((variances > 1e-10 * variances.max()).sum())
    if varying < num_synergies:
        raise ValueError(
            f"{len(actions)} actions that vary in {varying} dimensions are too few for "
            f"{num_synergies} synergies; collect more actions, or use fewer synergies."
        )
    return actions
