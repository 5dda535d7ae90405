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
    """z ∈ [-1, 1]^d → mean + z·basis, blended with a raw action, in the bounds."""

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
    """Decodes synergy coefficients into muscle actions by an affine map that does not learn.

    It stands wherever a :class:`~torchrl_etl.modules.SynergyDecoder` does, but has no parameters:
    everything in it is a buffer. Make one with :meth:`fit`.

    With a ``blend`` φ below 1 the synergy key has d + n entries, of which the last n are a raw
    action in [-1, 1]^n.

    Equation: a = φ·inverse(z) + (1 - φ)·a_raw, brought into the bounds, where inverse leads back
    through the scaling, the independent and the principal components.

    Deviates: the paper's critics value the coefficients and the raw action; under
    :class:`~torchrl_etl.objectives.SynergySACLoss` they value the executed action. See also
    :meth:`fit`.

    Args:
        mean (Tensor): the action of z = 0 [n].
        basis (Tensor): what a unit of each coefficient adds to it [d, n].

    Keyword Args:
        low, high (float, sequence of float or Tensor): action bounds, one or [n].
            Default: -1 and 1.
        blend (float): φ in (0, 1]; the paper's are 0.66 for hands and 1 (synergies only) for legs.
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

        Principal components, then independent ones, then a scaling of each coefficient to [-1, 1];
        all three are affine, and become one map here.

        Deviates: the public code is fitted on activations in [0, 1] but emits actions, which pass
        MyoSuite's sigmoid once more on their way to the muscles. Here ``actions`` are activations
        mapped back through it to action units, a = 1/2 + ln(x / (1 - x)) / 5, as the entry
        ``activation`` of ``make_env(..., activations=True)`` is already.

        Args:
            actions (Tensor): muscle activity [N, n] in action units, such as that of
                :func:`best_episodes`.
            num_synergies (int): number d of synergies. Default: 20.

        Keyword Args:
            low, high, blend: see the class.
            seed (int): of the search for independent components. Default: 0.
            in_keys, out_keys: see the class.

        Returns:
            SARDecoder: in the dtype and on the device of the actions.

        Raises:
            ValueError: if there are too few actions or dimensions in which they vary, or they do
                not fit (see :func:`~torchrl_etl.modules.recorded_actions.as_actions`).
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
        """Zero [*]: inside of the bounds the raw action moves an action as far as in the middle.

        An action that is clamped does not move at all; its noise counts as entropy all the same, as
        it does in the public code.
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
    """The actions of those episodes whose return is above a percentile of all returns.

    Where no episode lies above it, those with the highest return are taken.

    Args:
        actions (Tensor): one row for each step of each episode [N, n].
        returns (Tensor): the return of the episode that the row belongs to [N].

    Keyword Args:
        episodes (Tensor, optional): which episode that is [N], so that each counts once in the
            percentile. Default: ``None``, where each counts by its steps: the same where
            episodes are equally long.
        percentile (float): in [0, 100]. Default: 80.
        preview (Tensor, optional): returns of earlier episodes [M], one each, of which the
            percentile is taken. Default: ``None``, where it is that of these episodes.

    Returns:
        Tensor: the rows of the best episodes, in their order.

    Raises:
        ValueError: if the shapes do not fit, the percentile is out of its range, or the rows of an
            episode disagree on its return.

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
            f"blend is {blend}; it is the share of the synergies in an action and must lie in "
            "(0, 1]: the paper's are 0.66 for hands and 1 for legs."
        )


def _bounds(low: Any, high: Any, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Both bounds as [n], in the dtype and on the device of ``mean``."""
    low, high = as_bounds(low, high, len(mean))
    return low.to(mean), high.to(mean)


def _varying(actions: Tensor, num_synergies: int, low: Any, high: Any) -> Tensor:
    """The actions [N, n], if so many synergies can be found in them."""
    real = torch.promote_types(actions.dtype, torch.float32)
    low, high = _bounds(low, high, actions.new_zeros(actions.shape[-1:], dtype=real))
    actions = as_actions(actions, low=low, high=high, min_rows=num_synergies + 1)
    centered = actions.double() - actions.double().mean(0)
    variances = torch.linalg.eigvalsh(centered.T @ centered)
    varying = int((variances > 1e-10 * variances.max()).sum())
    if varying < num_synergies:
        raise ValueError(
            f"{len(actions)} actions that vary in {varying} dimensions are too few for "
            f"{num_synergies} synergies; collect more, or ask for fewer."
        )
    return actions
