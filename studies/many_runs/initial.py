"""The weights that runs begin with: the package's own, for the bodies that it has."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.data import Bounded

from torchrl_etl.modules import make_actor, make_critic
from torchrl_etl.objectives import LeanSACLoss

from .networks import BatchNormBody
from .settings import Shape

__all__ = ["initial_weights"]


def initial_weights(
    shape: Shape, seed: int, observations: int, emitted: int, actions: int, width: int
) -> tuple[list[Tensor], list[list[Tensor]]]:
    """Weights of a run's actor and critics; what further observations would weigh is zero."""
    torch.manual_seed(seed)
    if shape.body == "batch_norm":
        actor = BatchNormBody.initial(width, shape.actor, shape.blocks, 2 * emitted)
        critics = [
            BatchNormBody.initial(width + actions, shape.critic, shape.blocks, shape.bins)
            for _ in range(shape.num_critics)
        ]
        return actor, critics
    options = {"body": "residual", "layer_norm": True}
    spec = Bounded(-1.0, 1.0, shape=(emitted,))
    policy = make_actor(
        {"observation": observations}, spec, hidden=[shape.actor] * shape.blocks, **options
    )
    value = make_critic(
        {"observation": observations, "action": actions},
        hidden=[shape.critic] * shape.blocks,
        bins=shape.bins,
        **options,
    )
    support = torch.linspace(-shape.bound, shape.bound, shape.bins)
    loss = LeanSACLoss(
        policy, value, action_spec=spec, num_qvalue_nets=shape.num_critics, support=support
    )
    missing = width - observations

    def padded(weight: Tensor) -> Tensor:
        own, rest = weight.split([observations, weight.shape[-1] - observations], -1)
        return torch.cat([nn.functional.pad(own, (0, missing)), rest], -1)

    def weights(name: str, module: nn.Module) -> list[Tensor]:
        found = {k: w.detach() for k, w in loss._weights(name).items()}
        order = [name for name, _ in module.named_parameters()]
        first, *others = [found[name] for name in order]
        return [padded(first), *others]

    actor = weights("actor_network", policy)
    stacked = weights("qvalue_network", value)
    return actor, [[w[i] for w in stacked] for i in range(shape.num_critics)]
