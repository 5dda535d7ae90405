"""TorchRL's SAC loss without vmap: the same numbers from fewer operations."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torch.func import functional_call
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss
from torchrl.objectives.sac import compute_rsample_log_prob
from torchrl.objectives.utils import distance_loss

from torchrl_etl.modules.checks import check_choice
from torchrl_etl.objectives.checks import check_parts

__all__ = ["LeanSACLoss", "call"]


class LeanSACLoss(SACLoss):
    """:class:`torchrl.objectives.SACLoss`, number for number, in about half its time.

    On two small critics ``vmap`` costs more than it saves: it takes fused kernels apart (layer
    norm, the bias in a product) and passes every operation through one more dispatcher. Here the
    critics are evaluated one after the other, on the entries that they read and no others.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        qvalue_network (TensorDictModule): the critic, one module with one output; it is copied
            ``num_qvalue_nets`` times.

    Keyword Args:
        **kwargs: see :class:`torchrl.objectives.SACLoss`.

    Keys:
        those of SACLoss.

    Raises:
        TypeError: if the critic is not a TensorDictModule, or a ``value_network`` or
            ``skip_done_states`` is given.
        ValueError: for an unknown reduction.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.modules import make_actor, make_critic
        >>> from torchrl_etl.objectives import LeanSACLoss
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> loss = LeanSACLoss(
        ...     make_actor({"observation": 3}, spec),
        ...     make_critic({"observation": 3, "action": 2}),
        ...     action_spec=spec,
        ... )
        >>> observation, following = torch.randn(2, 4, 3)
        >>> loss_actor, *_ = loss(
        ...     observation=observation,
        ...     action=torch.zeros(4, 2),
        ...     next_observation=following,
        ...     next_reward=torch.zeros(4, 1),
        ...     next_done=torch.zeros(4, 1, dtype=torch.bool),
        ...     next_terminated=torch.zeros(4, 1, dtype=torch.bool),
        ... )
        >>> loss_actor.backward()
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        **kwargs: Any,
    ) -> None:
        check_parts("qvalue_network", qvalue_network, TensorDictModule)
        check_choice("reduction", kwargs.get("reduction") or "mean", ("mean", "sum", "none"))
        for name in ("value_network", "skip_done_states"):
            if kwargs.get(name):
                raise TypeError(
                    f"{name} is given but {type(self).__name__} bootstraps on its critics, at "
                    "every next state; leave it out."
                )
        super().__init__(actor_network, qvalue_network, **kwargs)

    def _make_vmap(self) -> None:
        """Nothing is vmapped."""

    def _sample(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """A fresh action and its log-probability; the tensordict is left as it is."""
        # A selection is a shallow copy: the actor writes loc and scale, graph and all, into it.
        observed = tensordict.select(*self.actor_network.in_keys)
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            return compute_rsample_log_prob(self.actor_network.get_dist(observed))

    def _at(self, tensordict: TensorDictBase, action: Tensor) -> TensorDictBase:
        """What the critics read where the actor's ``action`` is taken."""
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        return inputs.set(self.tensor_keys.action, action)

    def _values(self, inputs: TensorDictBase, weights: dict[str, Tensor]) -> Tensor:
        """Q-values [critics, *] with these weights, all of them stacked."""
        tensors = [inputs.get(key) for key in self.qvalue_network.in_keys]
        each = zip(*(weight.unbind(0) for weight in weights.values()), strict=True)
        values = [
            call(self.qvalue_network, dict(zip(weights, one, strict=True)), *tensors)
            for one in each
        ]
        return torch.stack(values).squeeze(-1)

    def _weights(self, network: str, *, detached: bool = False) -> dict[str, Tensor]:
        """Parameters and buffers of a network by their dotted names."""
        params = getattr(self, f"{network}_params")
        weights = {**dict(params.named_parameters()), **dict(params.named_buffers())}
        return {k: x.detach() for k, x in weights.items()} if detached else weights

    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        with torch.no_grad():
            following = tensordict.get("next")
            action, log_prob = self._sample(following)
            prefix = "target_" if self.delay_qvalue else ""
            weights = self._weights(f"{prefix}qvalue_network")
            values = self._values(self._at(following, action), weights)
            value = values.amin(0) - self._alpha * log_prob
            return self.value_estimator.value_estimate(
                tensordict, next_value=value.unsqueeze(-1)
            ).squeeze(-1)

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`torchrl.objectives.SACLoss.qvalue_v2_loss`."""
        target = self._compute_target_v2(tensordict)
        values = self._values(tensordict, self._weights("qvalue_network"))
        each = distance_loss(values, target.expand_as(values), self.loss_function).sum(0)
        error = (values.detach() - target).abs().amax(0)
        return self._reduced(each, tensordict), {"td_error": error}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`torchrl.objectives.SACLoss.actor_loss`."""
        action, log_prob = self._sample(tensordict)
        fixed = self._weights("qvalue_network", detached=True)
        values = self._values(self._at(tensordict, action), fixed)
        each = self._alpha * log_prob - values.min(0).values
        return self._reduced(each, tensordict), {"log_prob": log_prob.detach()}

    def _clear_weakrefs(self, *tds: TensorDictBase | str) -> None:
        # SACLoss also names target networks that it does not have: a compiled loss would make
        # them, detached, at every call.
        super()._clear_weakrefs(*(td for td in tds if not isinstance(td, str)))

    def _reduced(self, each: Tensor, tensordict: TensorDictBase) -> Tensor:
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(each, tensordict=tensordict, weights=weights)


def call(network: TensorDictModule, weights: dict[str, Tensor], *inputs: Tensor) -> Tensor:
    """A network's output for bare tensors, computed with other weights than its own."""
    own = {name.removeprefix("module."): weight for name, weight in weights.items()}
    return functional_call(network.module, own, inputs, tie_weights=False)
