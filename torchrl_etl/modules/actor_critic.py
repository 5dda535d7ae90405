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
    """Layers whose first, a linear one, reads several inputs that are never joined.

    Hence no gradient is computed for an input that needs none: under the actor loss the critics'
    inputs are the action, whose gradient is wanted, and the observation, whose is not.
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
    """x + W₂ relu(W₁ norm(x)), four times as wide inside (Lee 2024, SimBa).

    With ``bfloat16`` its products are of that precision; weights, sum and gradients are not.
    """

    def __init__(self, width: int, layer_norm: bool, bfloat16: bool) -> None:
        norm = [nn.LayerNorm(width)] if layer_norm else []
        super().__init__(*norm, nn.Linear(width, 4 * width), nn.ReLU(), nn.Linear(4 * width, width))
        self.bfloat16 = bfloat16

    def forward(self, hidden: Tensor) -> Tensor:
        if not self.bfloat16:  # as whoever calls it has it
            return hidden + super().forward(hidden)
        with torch.autocast(hidden.device.type, torch.bfloat16):
            return hidden + super().forward(hidden)


class _QuietTail(nn.Module):
    """Gives the last entries of a Gaussian one fixed standard deviation."""

    def __init__(self, count: int, std: float) -> None:
        check_integer(1, quiet=count)
        check_real("(0, inf)", quiet_std=std)
        super().__init__()
        self.count, self.std = count, std

    def forward(self, parameters: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        loc, scale = parameters
        tail = torch.full_like(scale[..., -self.count :], self.std)
        return loc, torch.cat([scale[..., : -self.count], tail], -1)


def make_layers(
    in_features: int, out_features: int, body: Body, hidden: Sequence[int], layer_norm: bool
) -> nn.Sequential:
    """The layers of an actor or a critic; called with as many tensors as it has inputs."""
    check_choice("body", body, get_args(Body))
    check_sizes(hidden=hidden)
    check_flag(layer_norm=layer_norm)
    if body != "mlp":
        if len(set(hidden)) != 1:
            raise ValueError(
                f"hidden is {list(hidden)}; a residual body adds each block to the one before, so "
                "its blocks must be of one width, such as [64, 64] for two of them."
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
    quiet: int = 0,
    quiet_std: float = 0.05,
) -> ProbabilisticActor:
    """Tanh-Gaussian actor whose samples fill the bounds of ``action_spec``.

    Args:
        inputs (mapping of NestedKey to int): keys that the actor reads, with their sizes; several
            keys are concatenated.
        action_spec (TensorSpec): one unbatched bounded leaf.

    Keyword Args:
        out_key (NestedKey): where the sample goes. Default: ``"action"``.
        body (str): ``"mlp"``; ``"residual"``, blocks that each add to what came before; or
            ``"residual_bfloat16"``, whose products inside blocks are of that precision: two thirds
            of the time on processors with instructions for it, slower on others.
        hidden (sequence of int): widths of the hidden layers, or of the residual blocks.
        layer_norm (bool): normalise each hidden layer, or what enters each block.
        quiet (int): so many of the last entries have a fixed standard deviation before the tanh,
            ``quiet_std``; the others' is learned. Default: 0.

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
    if quiet:
        layers.append(_QuietTail(quiet, quiet_std))
    return actor_with(TanhNormal, layers, inputs, ["loc", "scale"], action_spec, out_key)


def start_small(layers: nn.Sequential) -> None:
    """Let an actor's means start near the middle of the bounds.

    Whatever they later vary in was then learned: in stage 1 the GMVAE would otherwise fit the
    noise of the initialisation.
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
    """An actor that samples from a distribution within the bounds of ``action_spec``.

    The distribution is built from the parameters, which the network makes of the inputs, ``low``,
    ``high`` and ``kwargs``.
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
        bins (int): above one, the output is the logits of a categorical distribution of the
            return; see ``support`` of :class:`~torchrl_etl.objectives.LeanSACLoss`. Default: 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> critic = make_critic({"observation": 7, "action": 5})
        >>> data = TensorDict({"observation": torch.randn(3, 7), "action": torch.randn(3, 5)}, [3])
        >>> critic(data)["state_action_value"].shape
        torch.Size([3, 1])
    """
    check_integer(1, bins=bins)
    # Named here: ValueOperator calls it a state value unless a key is literally "action".
    return ValueOperator(
        make_layers(sum(inputs.values()), bins, body, hidden, layer_norm),
        in_keys=list(inputs),
        out_keys=["state_action_value"],
    )
