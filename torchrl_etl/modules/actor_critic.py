"""Actor and critic bodies shared by both stages and by plain SAC."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from tensordict.nn import InteractionType, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.data.tensor_specs import TensorSpec
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_etl.checks import check_choice, check_flag, check_integer, check_real, check_sizes
from torchrl_etl.modules.recorded_actions import bounds_of

__all__ = ["Body", "actor_with", "make_actor", "make_critic", "make_layers", "start_small"]


Body = Literal["mlp", "residual", "residual_bfloat16"]


class _Layers(nn.Sequential):
    """Layers whose first, linear layer takes several inputs without concatenating them.

    This skips the gradient of inputs that need none: the actor loss needs the critics' gradient
    with respect to the action, not the observation.
    """

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        first, *rest = self
        weights = first.weight.split([tensor.shape[-1] for tensor in inputs], dim=-1)
        hidden = nn.functional.linear(inputs[0], weights[0], first.bias)
        for tensor, weight in zip(inputs[1:], weights[1:], strict=True):
            hidden = hidden + nn.functional.linear(tensor, weight)
        for layer in rest:
            hidden = layer(hidden)
        return hidden


class _ResidualBlock(nn.Sequential):
    """x + W₂ relu(W₁ norm(x)) with hidden width 4·width (SimBa, Lee 2024).

    With ``bfloat16`` matrix products run in bfloat16; weights, their gradients and the sum do not.
    """

    def __init__(self, width: int, layer_norm: bool, bfloat16: bool) -> None:
        norm = [nn.LayerNorm(width)] if layer_norm else []
        super().__init__(*norm, nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width))
        self.bfloat16 = bfloat16

    def forward(self, hidden: Tensor) -> Tensor:
        if not self.bfloat16:  # the caller's autocast state
            return hidden + super().forward(hidden)
        with torch.autocast(hidden.device.type, torch.bfloat16):
            return hidden + super().forward(hidden)


class _FixedStdTail(nn.Module):
    """Fixes the standard deviation of a Gaussian's last ``count`` entries."""

    def __init__(self, count: int, std: float) -> None:
        check_integer(1, fixed_std_dims=count)
        check_real("(0, inf)", fixed_std=std)
        super().__init__()
        self.count, self.std = count, std

    def forward(self, parameters: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        loc, scale = parameters
        tail = torch.full_like(scale[..., -self.count :], self.std)
        return loc, torch.cat([scale[..., : -self.count], tail], -1)


def make_layers(
    in_features: int, out_features: int, body: Body, hidden: Sequence[int], layer_norm: bool
) -> nn.Sequential:
    """Layers of an actor or critic, to be called with one tensor per input."""
    check_choice("body", body, get_args(Body))
    check_sizes(hidden=hidden)
    check_flag(layer_norm=layer_norm)
    if body != "mlp":
        if len(set(hidden)) != 1:
            raise ValueError(
                f"hidden is {list(hidden)}; a residual body adds each block to the one before, so "
                "all blocks must have the same width, such as [64, 64] for two of them."
            )
        width = hidden[0]
        bfloat16 = body == "residual_bfloat16"
        blocks = [_ResidualBlock(width, layer_norm, bfloat16) for _ in hidden]
        norm = [nn.LayerNorm(width)] if layer_norm else []
        head = nn.Linear(width, out_features)
        return _Layers(nn.Linear(in_features, width), *blocks, *norm, head)
    mlp = MLP(
        in_features,
        out_features,
        num_cells=list(hidden),
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm if layer_norm else None,
        norm_kwargs=[{"normalized_shape": width} for width in hidden] if layer_norm else None,
    )
    return _Layers(*mlp)


def make_actor(
    inputs: Mapping[NestedKey, int],
    action_spec: TensorSpec,
    *,
    out_key: NestedKey = "action",
    body: Body = "mlp",
    hidden: Sequence[int] = (256, 256),
    layer_norm: bool = True,
    fixed_std_dims: int = 0,
    fixed_std: float = 0.05,
) -> ProbabilisticActor:
    """Tanh-Gaussian actor scaled to the bounds of ``action_spec``.

    Args:
        inputs (mapping of NestedKey to int): keys that the actor reads, with their sizes; several
            keys are concatenated.
        action_spec (TensorSpec): one unbatched bounded leaf.

    Keyword Args:
        out_key (NestedKey): key of the sample. Default: ``"action"``.
        body (str): ``"mlp"``; ``"residual"``, residual blocks; or ``"residual_bfloat16"``, the same
            with matrix products inside blocks in bfloat16. These take two thirds of the time on
            processors with bfloat16 instructions, and longer on others.
        hidden (sequence of int): widths of the hidden layers, or of the residual blocks.
        layer_norm (bool): normalize each hidden layer, or the inputs of residual blocks and head.
        fixed_std_dims (int): number of last entries whose standard deviation before the tanh is
            ``fixed_std``, not learned. Default: 0.

    Keys:
        reads ``inputs``; writes ``loc``, ``scale`` [*, n] (before the tanh) and ``out_key`` [*, n].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> actor = make_actor({"observation": 7, "direction": 4}, Bounded(0, 1, shape=(80,)))
        >>> entries = {"observation": torch.randn(3, 7), "direction": torch.randn(3, 4)}
        >>> action = actor(TensorDict(entries, [3]))["action"]
        >>> action.shape, bool((action >= 0).all())
        (torch.Size([3, 80]), True)
    """
    layers = make_layers(sum(inputs.values()), 2 * action_spec.shape[-1], body, hidden, layer_norm)
    start_small(layers)
    layers.append(NormalParamExtractor(scale_mapping="biased_softplus_1.0", scale_lb=1e-3))
    if fixed_std_dims:
        layers.append(_FixedStdTail(fixed_std_dims, fixed_std))
    return actor_with(TanhNormal, layers, inputs, ["loc", "scale"], action_spec, out_key)


def start_small(layers: nn.Sequential) -> None:
    """Initialize an actor's means near the middle of the bounds.

    All later variation is then learned; otherwise the GMVAE of stage 1 would fit the random
    initialization.
    """
    with torch.no_grad():
        layers[-1].weight.mul_(0.01)
        layers[-1].bias.zero_()


def actor_with(
    distribution: type[Distribution],
    network: nn.Module,
    inputs: Iterable[NestedKey],
    parameters: Sequence[str],
    action_spec: TensorSpec,
    out_key: NestedKey,
    **kwargs: Any,
) -> ProbabilisticActor:
    """Actor that samples from a distribution within the bounds of ``action_spec``.

    The distribution takes the network's outputs (``parameters``), ``low`` and ``high`` of the spec,
    and ``kwargs``.
    """
    low, high = bounds_of(action_spec)
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=list(inputs), out_keys=list(parameters)),
        in_keys=list(parameters),
        out_keys=[out_key],
        spec=action_spec,
        distribution_class=distribution,
        distribution_kwargs={"low": low, "high": high, **kwargs},
        default_interaction_type=InteractionType.RANDOM,
    )


def make_critic(
    inputs: Mapping[NestedKey, int],
    *,
    body: Body = "mlp",
    hidden: Sequence[int] = (256, 256),
    layer_norm: bool = True,
    bins: int = 1,
) -> ValueOperator:
    """Q-network on the concatenation of ``inputs``; writes ``state_action_value`` [*, bins].

    Args:
        inputs (mapping of NestedKey to int): keys that the critic reads, with their sizes.

    Keyword Args:
        body, hidden, layer_norm: as in :func:`make_actor`.
        bins (int): number of outputs; several are logits of a categorical return distribution. See
            ``support`` of :class:`~torchrl_etl.objectives.LeanSACLoss`. Default: 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> critic = make_critic({"observation": 7, "action": 5})
        >>> data = TensorDict({"observation": torch.randn(3, 7), "action": torch.randn(3, 5)}, [3])
        >>> critic(data)["state_action_value"].shape
        torch.Size([3, 1])
    """
    check_integer(1, bins=bins)
    # ValueOperator would name the output a state value unless a key is literally "action".
    return ValueOperator(
        make_layers(sum(inputs.values()), bins, body, hidden, layer_norm),
        in_keys=list(inputs),
        out_keys=["state_action_value"],
    )
