"""DynSyn: one action for each group of muscles, and small deviations from it (He 2024)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch import distributions as D
from torchrl.data.tensor_specs import TensorSpec
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal

from torchrl_etl.checks import check_real
from torchrl_etl.draws import standard_normal
from torchrl_etl.modules.actor_critic import Body, actor_with, make_layers, start_small
from torchrl_etl.modules.scheduled import Scheduled
from torchrl_etl.objectives.sac import rsample_and_log_prob

__all__ = ["DynSynNetwork", "GroupedTanhNormal", "MuscleGroups", "make_dynsyn_actor"]

# Weights of members stay within 10 % of 1, even before the amplitude limits them.
_DEVIATION = 0.1
_WEIGHT_SCALE = math.exp(0.5)  # standard deviation before the tanh


class MuscleGroups(NamedTuple):
    """Muscle groups as index tensors.

    Attributes:
        group: number of each muscle's group [n].
        first: first member of each group [k].
        slot: position of each muscle among those with a deviation [n], from 1; 0 for the first
            members, which have none.
    """

    group: Tensor
    first: Tensor
    slot: Tensor

    @classmethod
    def of(cls, groups: Tensor | Sequence[int]) -> MuscleGroups:
        """Build from the group number of each muscle.

        Examples:
            >>> MuscleGroups.of([0, 1, 0, 0]).slot
            tensor([0, 0, 1, 2])
        """
        group = torch.as_tensor(groups)
        count = int(group.max()) + 1 if group.numel() else 0
        if group.ndim != 1 or group.is_floating_point() or set(group.tolist()) != {*range(count)}:
            raise ValueError(
                f"groups is {group.tolist()}; it must hold the index of each muscle's group, and "
                "use every index from 0 to the largest."
            )
        first = torch.tensor([group.tolist().index(number) for number in range(count)])
        others = torch.ones_like(group).index_fill(0, first, 0)
        return cls(group.long(), first, (others * others.cumsum(0)).long())

    @property
    def num_groups(self) -> int:
        return len(self.first)

    @property
    def num_muscles(self) -> int:
        return len(self.group)


class GroupedTanhNormal(D.Distribution):
    """Tanh-Gaussian over k groups of n muscles; every member follows its group.

    Where bounds are [-1, 1], a muscle's action is its group's action y times a weight, clamped to
    the bounds. The weight is 1 for a group's first member. For the others it is
    w = 1 + clip(0.1 tanh(v), ±amplitude), v ~ N(weight_loc, e).

    The log-probability covers y alone, read from the first members: a density over k dimensions.

    Args:
        loc, scale (Tensor): mean and deviation of the groups [*, k] before the tanh.
        weight_loc (Tensor): mean of v [*, n - k] for members that are not first, in muscle order.
        amplitude (Tensor): largest deviation of a weight from 1 [*, 1], in [0, 0.1].
        group, first, slot (Tensor): the groups [*, n], [*, k] and [*, n], see
            :class:`MuscleGroups`.

    Keyword Args:
        low, high (float or Tensor): bounds, one number or [n]. Default: ±1.

    Examples:
        >>> import torch
        >>> groups = MuscleGroups.of([0, 1, 0])
        >>> grouped = GroupedTanhNormal(
        ...     torch.zeros(2), torch.ones(2), torch.zeros(1), torch.zeros(1), *groups
        ... )
        >>> action = grouped.sample()
        >>> bool(action[0] == action[2]), bool(action[0] == action[1])
        (True, False)
    """

    arg_constraints: dict = {}  # noqa: RUF012  (torch declares it so)
    has_rsample = True

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        weight_loc: Tensor,
        amplitude: Tensor,
        group: Tensor,
        first: Tensor,
        slot: Tensor,
        *,
        low: float | Tensor = -1.0,
        high: float | Tensor = 1.0,
    ) -> None:
        self.group, self.first, self.slot = group, first, slot
        self.low, self.high = (
            torch.as_tensor(bound, dtype=loc.dtype, device=loc.device).expand(group.shape[-1:])
            for bound in (low, high)
        )
        self.center, self.half = (self.high + self.low) / 2, (self.high - self.low) / 2
        self.group_normal = TanhNormal(loc, scale)  # where bounds are ±1
        self.weight_loc, self.amplitude = weight_loc, amplitude
        super().__init__(loc.shape[:-1], self.low.shape, validate_args=False)

    def rsample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        return self.rsample_and_log_prob(sample_shape)[0]

    def rsample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Samples [S, *, n] with their log-probabilities [S, *], exact at the bounds too."""
        shared, log_prob = rsample_and_log_prob(self.group_normal, sample_shape)
        noise = standard_normal(self.weight_loc.expand(*sample_shape, *self.weight_loc.shape))
        action = self._spread(shared, self.weight_loc + _WEIGHT_SCALE * noise)
        return action, log_prob - self._log_half

    def log_prob(self, value: Tensor) -> Tensor:
        unit = gather_last((value - self.center) / self.half, self.first)
        return self.group_normal.log_prob(unit) - self._log_half

    @property
    def deterministic_sample(self) -> Tensor:
        """The action [*, n] with all Gaussians at their means."""
        return self._spread(self.group_normal.deterministic_sample, self.weight_loc)

    @property
    def _log_half(self) -> Tensor:
        """Log half width of the first members' bounds, summed over groups [*]."""
        return gather_last(self.half.log(), self.first).sum(-1)

    def _spread(self, shared: Tensor, weight: Tensor) -> Tensor:
        """Actions [*, n] from the groups' actions in ±1 [*, k] and v [*, n - k]."""
        change = (_DEVIATION * weight.tanh()).clamp(-self.amplitude, self.amplitude)
        change = torch.cat([change.new_zeros(*change.shape[:-1], 1), change], -1)
        change = gather_last(change, self.slot)
        weighted = gather_last(shared, self.group) * (1 + change)
        return (self.center + self.half * weighted).clamp(self.low, self.high)


def gather_last(values: Tensor, index: Tensor) -> Tensor:
    """Gather entries [*, k] of values [*, n] by an index [*, k]; batch sizes may broadcast.

    Examples:
        >>> gather_last(torch.tensor([[5, 6], [7, 8]]), torch.tensor([1, 1, 0]))
        tensor([[6, 6, 5],
                [8, 8, 7]])
    """
    shape = torch.broadcast_shapes(values.shape[:-1], index.shape[:-1])
    return values.expand(*shape, -1).gather(-1, index.expand(*shape, -1))


class DynSynNetwork(nn.Module, Scheduled):
    """Network of a DynSyn actor: outputs the parameters of :class:`GroupedTanhNormal`.

    They include the groups, which may differ between actors that are updated side by side. The
    layers must have k + n outputs.

    Equation: amplitude(t) = clip(slope (t - start), 0, ceiling), with t in frames.
    """

    def __init__(
        self,
        layers: nn.Sequential,
        groups: MuscleGroups,
        *,
        slope: float,
        start: int,
        ceiling: float,
    ) -> None:
        super().__init__()
        self.layers = layers
        self.normal = NormalParamExtractor(scale_mapping="biased_softplus_1.0", scale_lb=1e-3)
        self.sizes = (2 * groups.num_groups, groups.num_muscles - groups.num_groups)
        self.slope, self.start, self.ceiling = slope, start, ceiling
        # A buffer, so that weight updates also raise the workers' amplitude.
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        for name, index in groups._asdict().items():
            self.register_buffer(name, index, persistent=False)

    def advance(self, frames: int) -> None:
        self.frames.fill_(frames)

    @property
    def amplitude(self) -> Tensor:
        """Current largest deviation of a weight from 1 []."""
        return (self.slope * (self.frames - self.start)).clamp(0, self.ceiling)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        shared, weight_loc = self.layers(*inputs).split(self.sizes, -1)
        loc, scale = self.normal(shared)
        amplitude = self.amplitude.to(loc).unsqueeze(-1)
        fixed = (amplitude, self.group, self.first, self.slot)
        # Copies: clearing an actor's outputs must not clear its buffers.
        shape = (*loc.shape[:-1], -1)
        return loc, scale, weight_loc, *(each.expand(shape).clone() for each in fixed)


def make_dynsyn_actor(
    inputs: Mapping[NestedKey, int],
    action_spec: TensorSpec,
    groups: Tensor | Sequence[int],
    *,
    out_key: NestedKey = "action",
    body: Body = "mlp",
    hidden: Sequence[int] = (256, 256),
    layer_norm: bool = True,
    slope: float = 5e-8,
    start: int = 1_000_000,
    ceiling: float = 0.1,
) -> ProbabilisticActor:
    """Actor that moves muscles in groups and later learns deviations of their members.

    At first the members of a group get the same action. Once :meth:`DynSynNetwork.advance` passes
    ``start``, their weights may deviate; with the defaults, by up to 10 % at 3,000,000 frames.

    Its log-probability covers k dimensions, so SAC's target entropy should too.

    Deviates: the last layer starts small and maps to scales as in
    :func:`~torchrl_etl.modules.make_actor`; the original's is an ordinary SAC's.

    Args:
        inputs (mapping of NestedKey to int): keys that the actor reads, with their sizes.
        action_spec (TensorSpec): one unbatched bounded leaf, of n muscles.
        groups (Tensor or sequence of int): group number of each muscle [n], from
            :func:`~torchrl_etl.baselines.muscle_groups.group_muscles`.

    Keyword Args:
        out_key (NestedKey): where the sample goes. Default: ``"action"``.
        body, hidden, layer_norm: as in :func:`~torchrl_etl.modules.make_actor`.
        slope, start, ceiling (float): of the amplitude, see :class:`DynSynNetwork`.

    Keys:
        reads ``inputs``; writes ``loc``, ``scale`` [*, k], ``weight_loc`` [*, n - k], ``amplitude``
        [*, 1], ``group`` [*, n], ``first`` [*, k], ``slot`` [*, n] and ``out_key`` [*, n] within
        the bounds.

    Raises:
        ValueError: if groups are not [n] or skip a number, slope is negative, or ceiling is outside
            [0, 0.1].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> actor = make_dynsyn_actor({"observation": 7}, Bounded(0, 1, shape=(4,)), [0, 1, 1, 0])
        >>> action = actor(TensorDict({"observation": torch.randn(3, 7)}, [3]))["action"]
        >>> torch.equal(action[:, 0], action[:, 3])
        True
        >>> actor[0].module.advance(2_000_000)
        >>> actor[0].module.amplitude
        tensor(0.0500)
    """
    groups = MuscleGroups.of(groups)
    n = action_spec.shape[-1]
    if groups.num_muscles != n:
        raise ValueError(
            f"groups has {groups.num_muscles} muscles but the action has {n}; use groups that were "
            "found on this body."
        )
    check_real(f"[0, {_DEVIATION}]", ceiling=ceiling)
    check_real("[0, inf)", slope=slope)
    layers = make_layers(sum(inputs.values()), groups.num_groups + n, body, hidden, layer_norm)
    start_small(layers)
    network = DynSynNetwork(layers, groups, slope=slope, start=start, ceiling=ceiling)
    parameters = ["loc", "scale", "weight_loc", "amplitude", *MuscleGroups._fields]
    return actor_with(GroupedTanhNormal, network, inputs, parameters, action_spec, out_key)
