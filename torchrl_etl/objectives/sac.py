"""TorchRL's SAC loss without vmap: the same numbers from fewer operations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torch.func import functional_call
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal
from torchrl.objectives import SACLoss
from torchrl.objectives.sac import compute_rsample_log_prob
from torchrl.objectives.utils import ValueEstimators, distance_loss
from torchrl.objectives.value import TD0Estimator

from torchrl_etl.checks import check_choice, check_integer
from torchrl_etl.draws import standard_normal
from torchrl_etl.functional import categorical_cross_entropy, categorical_mean, project_categorical
from torchrl_etl.modules.calls import calls_module_only
from torchrl_etl.objectives.checks import check_parts, read

__all__ = ["LeanSACLoss", "call"]


class LeanSACLoss(SACLoss):
    """:class:`torchrl.objectives.SACLoss` with the same values, in about half the time.

    On two small critics ``vmap`` costs more than it saves: it splits fused kernels (layer norm,
    the bias of a linear layer) and adds a dispatcher to every operation. Here the critics are
    evaluated one after the other, on only the entries that they read.

    With a ``support`` the critics are categorical: they output logits of a return distribution on
    it. Their target is the distribution of the critic with the smallest mean, shifted by the
    entropy bonus and the reward, shrunk by the discount, and projected back (Bellemare 2017). The
    actor maximizes the smallest mean.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy; a composite distribution has
            its parts under one key, the action.
        qvalue_network (TensorDictModule): the critic, copied ``num_qvalue_nets`` times. A module
            of tensors with one output is called without a tensordict; others (sequences, inputs
            by keyword, several outputs) are somewhat slower.

    Keyword Args:
        support (Tensor, optional): evenly spaced returns [K], ascending; the critics then have K
            outputs. It is copied to their device. Default: ``None``, one output, the value itself.
        loss_function (str): ``"l2"``, ``"l1"`` or ``"smooth_l1"``, for scalar critics; categorical
            critics always minimize cross entropy. ``"l2"`` is the squared error, summed over
            critics; Stable-Baselines3 takes half of it. Default: ``"l2"``. TorchRL's is
            ``"smooth_l1"``, but only the square makes critics estimate the *mean* return.
        entropy_dims (int, optional): measure the entropy of only the first ``entropy_dims`` entries
            of a tanh-Gaussian sample, if the actor cannot choose the others' noise. Default: all.
        **kwargs: see :class:`torchrl.objectives.SACLoss`.

    Keys:
        as in SACLoss.

    Raises:
        TypeError: if actor or critic is of the wrong class, or a ``value_network`` or
            ``skip_done_states`` is given.
        ValueError: for an unknown reduction or ``loss_function``, a support that is not evenly
            spaced and ascending or not of the critics' size, ``entropy_dims`` with an actor that
            is no tanh-Gaussian, an actor that samples several keys, or a critic with several
            outputs but no ``state_action_value``.

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

    support: Tensor | None

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        *,
        support: Tensor | None = None,
        loss_function: Literal["l2", "l1", "smooth_l1"] = "l2",
        entropy_dims: int | None = None,
        **kwargs: Any,
    ) -> None:
        check_parts("actor_network", actor_network, ProbabilisticTensorDictSequential)
        check_parts("qvalue_network", qvalue_network, TensorDictModule)
        if len(sampled := list(actor_network.dist_sample_keys)) != 1:
            raise ValueError(
                f"The actor samples {sampled}; a composite action must be under one key: give the "
                "actor out_keys=['action'] and its distribution no name_map."
            )
        if entropy_dims is not None:
            check_integer(1, entropy_dims=entropy_dims)
            kind = actor_network[-1].distribution_class
            if not (isinstance(kind, type) and issubclass(kind, TanhNormal)):
                raise ValueError(
                    f"entropy_dims is {entropy_dims}, but the actor is not a tanh-Gaussian; leave "
                    "entropy_dims out, or give the actor TanhNormal as its distribution."
                )
        check_choice("reduction", kwargs.get("reduction") or "mean", ("mean", "sum", "none"))
        check_choice("loss_function", loss_function, ("l2", "l1", "smooth_l1"))
        for name in ("value_network", "skip_done_states"):
            if kwargs.get(name):
                raise TypeError(
                    f"{name} is given but {type(self).__name__} bootstraps from its critics at "
                    "every next state; leave it out."
                )
        super().__init__(actor_network, qvalue_network, loss_function=loss_function, **kwargs)
        if support is not None:
            if not support.is_floating_point():  # of torch.arange(-5, 6)
                support = support.float()
            _check_support(support)
            support = support.detach().to(self.alpha_init.device, copy=True)
        self.register_buffer("support", support)
        self.entropy_dims = entropy_dims

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """See :meth:`torchrl.objectives.common.LossModule.set_keys`.

        Raises:
            ValueError: if the critic has several outputs and none is ``state_action_value``.
        """
        super().set_keys(**kwargs)
        self._value_key = value_key(self.qvalue_network, self.tensor_keys.state_action_value)

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """See :meth:`torchrl.objectives.SACLoss.make_value_estimator`.

        Raises:
            ValueError: for an estimator other than TD0 with a ``support``.
        """
        one_step = value_type in (None, ValueEstimators.TD0, TD0Estimator)
        if self.support is not None and not (one_step or isinstance(value_type, TD0Estimator)):
            raise ValueError(
                f"value_type is {value_type}, but targets with a support are one-step "
                "distributions; use ValueEstimators.TD0, or leave the support out."
            )
        return super().make_value_estimator(value_type, **hyperparams)

    def _make_vmap(self) -> None:
        """Nothing is vmapped."""

    def _sample(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """A fresh action and its log-probability; the tensordict is not modified."""
        # A copy, since the actor writes loc and scale with their graph. A composite distribution
        # lists its parameters among the in-keys; they may be missing.
        observed = tensordict.select(*self.actor_network.in_keys, strict=False).copy()
        with (
            set_exploration_type(ExplorationType.RANDOM),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            return rsample_and_log_prob(
                self.actor_network.get_dist(observed), entropy_dims=self.entropy_dims
            )

    def _at(self, tensordict: TensorDictBase, action: Tensor) -> TensorDictBase:
        """The critics' inputs, with the actor's ``action``."""
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        return inputs.set(self.tensor_keys.action, action)

    def _outputs(self, inputs: TensorDictBase, weights: dict[str, Tensor]) -> Tensor:
        """Outputs [critics, *, K or 1] of the critics with these stacked weights."""
        each = zip(*(weight.unbind(0) for weight in weights.values()), strict=True)
        outputs = [
            call(self.qvalue_network, dict(zip(weights, one, strict=True)), inputs, self._value_key)
            for one in each
        ]
        return torch.stack(outputs)

    def _mean(self, outputs: Tensor) -> Tensor:
        """Q-values [critics, *] of these outputs."""
        bins = 1 if self.support is None else len(self.support)
        if outputs.shape[-1] != bins:
            raise ValueError(
                f"The critics write a last size of {outputs.shape[-1]} but the support has {bins} "
                "bins (1 means no support); make both equal: make_critic(bins=...), "
                "support=torch.linspace(...)."
            )
        if self.support is None:
            return outputs.squeeze(-1)
        return categorical_mean(outputs, self.support)

    def _weights(self, network: str, *, detached: bool = False) -> dict[str, Tensor]:
        """Parameters and buffers of a network by their dotted names."""
        # Not named_parameters: it names the loss's own even while others are swapped in.
        leaves = getattr(self, f"{network}_params").items(True, True)
        weights = {k if isinstance(k, str) else ".".join(k): x for k, x in leaves}
        return {k: x.detach() for k, x in weights.items()} if detached else weights

    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        """Target values [*]; with categorical critics, target probabilities [*, K]."""
        with torch.no_grad():
            following = read(type(self).__name__, tensordict, "next")
            action, log_prob = self._sample(following)
            prefix = "target_" if self.delay_qvalue else ""
            weights = self._weights(f"{prefix}qvalue_network")
            outputs = self._outputs(self._at(following, action), weights)
            if self.support is None:
                value = self._mean(outputs).amin(0) - self._alpha * log_prob
                return self._bootstrap(tensordict, value)
            smaller = self._mean(outputs).argmin(0)[None, ..., None].expand_as(outputs[:1])
            probabilities = outputs.gather(0, smaller).squeeze(0).softmax(-1)
            # The target is affine in the next value: two values determine it on the whole support.
            start = self._bootstrap(tensordict, torch.zeros_like(log_prob))
            slope = self._bootstrap(tensordict, torch.ones_like(log_prob)) - start
            following_atoms = self.support - (self._alpha * log_prob).unsqueeze(-1)
            atoms = start.unsqueeze(-1) + slope.unsqueeze(-1) * following_atoms
            return project_categorical(probabilities, atoms, self.support)

    def _bootstrap(self, tensordict: TensorDictBase, next_value: Tensor) -> Tensor:
        estimate = self.value_estimator.value_estimate
        return estimate(tensordict, next_value=next_value.unsqueeze(-1)).squeeze(-1)

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`torchrl.objectives.SACLoss.qvalue_v2_loss`."""
        target = self._compute_target_v2(tensordict)
        outputs = self._outputs(tensordict, self._weights("qvalue_network"))
        values = self._mean(outputs)
        if self.support is None:
            each = distance_loss(values, target.expand_as(values), self.loss_function)
        else:
            each = categorical_cross_entropy(outputs, target)
            target = target @ self.support
        error = (values.detach() - target).abs().amax(0)
        return self._reduced(each.sum(0), tensordict), {"td_error": error}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`torchrl.objectives.SACLoss.actor_loss`."""
        action, log_prob = self._sample(tensordict)
        fixed = self._weights("qvalue_network", detached=True)
        values = self._mean(self._outputs(self._at(tensordict, action), fixed))
        each = self._alpha * log_prob - values.min(0).values
        return self._reduced(each, tensordict), {"log_prob": log_prob.detach()}

    def _clear_weakrefs(self, *tds: TensorDictBase | str) -> None:
        # SACLoss also names target networks that do not exist: a compiled loss would create them,
        # detached, at every call.
        super()._clear_weakrefs(*(td for td in tds if not isinstance(td, str)))

    def _reduced(self, each: Tensor, tensordict: TensorDictBase) -> Tensor:
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(each, tensordict=tensordict, weights=weights)


def _check_support(support: Tensor) -> None:
    steps = support.diff()
    if (
        support.ndim != 1
        or len(support) < 2
        or not (steps > 0).all()
        or steps.std(correction=0) > 1e-4 * steps.mean()
    ):
        raise ValueError(
            f"support has shape {list(support.shape)}; it must be two or more evenly spaced, "
            "ascending entries; make it with torch.linspace(low, high, bins)."
        )


def rsample_and_log_prob(
    distribution: Distribution, sample_shape: Sequence[int] = (), entropy_dims: int | None = None
) -> tuple[Tensor, Tensor]:
    """Reparametrized samples [S, *, n] with their log-probabilities [S, *].

    For a tanh-Gaussian, only the first ``entropy_dims`` entries count in the log-probability.

    ``Normal.rsample`` is avoided: it fills an empty tensor in place, which ``torch.vmap`` refuses.
    """
    if not isinstance(distribution, TanhNormal):
        return compute_rsample_log_prob(distribution)
    loc, scale = distribution.loc, distribution.scale
    preimage = loc + scale * standard_normal(loc.expand(*sample_shape, *loc.shape))
    transform = distribution.transforms[0]
    action = transform(preimage)
    slope = transform.log_abs_det_jacobian(preimage, action)
    each = distribution.base_dist.base_dist.log_prob(preimage) - slope
    return action, each[..., :entropy_dims].sum(-1)


def value_key(critic: TensorDictModule, name: NestedKey) -> NestedKey:
    """Key of a critic's value: its only output, or the one of this name."""
    outputs = list(critic.out_keys)
    if len(outputs) == 1:
        return outputs[0]
    if name in outputs:
        return name
    raise ValueError(
        f"The critic writes {outputs}; one of them must be {name!r}, which the loss reads."
    )


def call(
    network: TensorDictModule,
    weights: dict[str, Tensor],
    inputs: TensorDictBase,
    out_key: NestedKey,
) -> Tensor:
    """A network's output with the given weights; ``inputs`` is not modified."""
    if len(network.out_keys) > 1 or not calls_module_only(network):
        inputs = inputs.select(*network.in_keys, strict=False).copy()
        return functional_call(network, weights, (inputs,), tie_weights=False).get(out_key)
    own = {name.removeprefix("module."): weight for name, weight in weights.items()}
    tensors = tuple(read("The critic", inputs, key) for key in network.in_keys)
    return functional_call(network.module, own, tensors, tie_weights=False)
