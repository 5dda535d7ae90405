"""The behavioral metric that shapes the state encoder (Eqs. 2, 3, 5, 6)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_etl import functional
from torchrl_etl.checks import check_choice, check_flag, check_real
from torchrl_etl.objectives.checks import check_parts
from torchrl_etl.objectives.pairs import (
    embedded_ends,
    outputs,
    partners,
    read_scalars,
    target_params,
)

__all__ = ["BehavioralMetricLoss"]

_DISTANCES: Mapping[str, Callable[[Tensor, Tensor], Tensor]] = {
    "l2": functional.l2_distance,
    "mico": functional.mico_distance,
}


class BehavioralMetricLoss(LossModule):
    r"""Loss that trains distances between state embeddings to be behavioral distances.

    It pairs transitions within the batch. The distance of their embeddings regresses to their
    reward difference plus ``gamma`` times the divergence of their next states. A regularizer keeps
    pairs with nearly equal rewards from collapsing.

    Equation: 6 (with 2, 3 and 5): ``loss_metric + loss_regularizer``.

    Keys:
        reads the encoder's ``in_keys`` (``observation`` [*, O]), the same below ``"next"``,
        ``("next", "reward")`` [*, 1] and ``("next", "terminated")`` [*, 1] bool. Writes

        - ``loss_metric``: Eq. 3;
        - ``loss_regularizer``: Eq. 5 times ``weight`` (absent with ``regularizer="none"``);
        - ``loss_dynamics``: negative log-likelihood of the next embedding, each dimension times
          its own detached standard deviation (``"gaussian"`` only);
        - ``mean_distance``, ``mean_reward_difference``: over the pairs, detached; Theorem 1 relates
          them (:func:`~torchrl_etl.functional.expected_distance`);
        - ``effective_rank``: of the embeddings, detached; near 1 means one used dimension.

    Deviates:
        - Eq. 5: as printed it contracts the pairs that it is said to keep apart. The default is a
          hinge; ``"literal"`` is as printed (:func:`~torchrl_etl.functional.discriminability`).
        - The paper leaves the divergence of Eq. 2 open: ``"sampled"`` is the distance of the
          sampled next states (MICo), ``"gaussian"`` the 2-Wasserstein distance of a latent model's
          predictions (DBC). Both use a target encoder: bootstrapped on the same encoder, distances
          diverge. The latent model's likelihood is weighted by its standard deviation. Unweighted,
          near-deterministic transitions shrank the deviation until single gradients threw the
          means off, and distances diverged (to 4e5 where Eq. 4 says 1.7).
        - The paper does not treat termination. Here all terminated next states are one absorbing
          state, embedded at the origin. Two ended episodes have distance zero; a state's distance
          from the end is the norm of its embedding. (For MICo's diffuse metric it is half the
          square of the norm, and the origin is exact: a state without any further reward has norm
          zero.) Truncation bootstraps as usual.

    Args:
        encoder (TensorDictModule): the state encoder; its first out key is the embedding [*, k].
        dynamics (TensorDictModule, optional): latent dynamics, embedding → mean and standard
            deviation of the next embedding. Only for ``divergence="gaussian"``, which needs it.

    Keyword Args:
        divergence (str): ``"sampled"`` or ``"gaussian"``. Default: ``"sampled"``.
        distance (str): ``"l2"`` or ``"mico"``. Default: ``"l2"``.
        regularizer (str): ``"hinge"``, ``"literal"`` or ``"none"``. Default: ``"hinge"``.
        pairs (str): ``"permuted"`` pairs each sample with one other drawn at random, ``"all"``
            with every other (MICo's choice). No sample is ever paired with itself. On batches of
            256 both learn alike and ``"all"`` costs three times as much.
            Default: ``"permuted"``.
        epsilon (float): pairs whose (scaled) rewards differ by less are regularized.
            Default: ``0.01``.
        margin (float): distance from which the hinge is zero. Default: ``1.0``.
        weight (float): the regularizer's weight λ in Eq. 6. Default: ``0.1``.
        gamma (float): discount factor in [0, 1). Default: ``0.95``.
        reward_scale (float): factor on the rewards, which sets the unit of every distance. It is
            a buffer: it is saved with the loss and may be assigned at any time. Default: ``1.0``.
        delay_encoder (bool): keep a target encoder, which ``SoftUpdate`` updates. Otherwise targets
            use the current encoder, detached. Default: ``True``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"`` (one value per sample, averaged over
            its pairs). Default: ``"mean"``.

    Raises:
        ValueError: at construction for an unknown choice, a number out of range, or incompatible
            options; in ``forward`` for a batch of one sample, which has no pairs.
        TypeError: if a network is not a TensorDict module.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_etl.modules import StateEncoder
        >>> from torchrl_etl.objectives import BehavioralMetricLoss
        >>> loss = BehavioralMetricLoss(StateEncoder(observation_dim=7, embedding_dim=4))
        >>> updater = SoftUpdate(loss, tau=0.01)
        >>> batch = TensorDict({"observation": torch.randn(32, 7)}, [32])
        >>> batch["next"] = {
        ...     "observation": torch.randn(32, 7),
        ...     "reward": torch.randn(32, 1),
        ...     "terminated": torch.zeros(32, 1, dtype=torch.bool),
        ... }
        >>> out = loss(batch)
        >>> (out["loss_metric"] + out["loss_regularizer"]).backward()
        >>> updater.step()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change; both are read below ``"next"``.

        Attributes:
            reward (NestedKey): the task's own reward. Default: ``"reward"``.
            terminated (NestedKey): end of the episode in a terminal state.
                Default: ``"terminated"``.
        """

        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    _schedulable_buffers = frozenset({"reward_scale"})

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    dynamics: TensorDictModuleBase
    dynamics_params: TensorDictParams
    target_dynamics_params: TensorDictParams

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        dynamics: TensorDictModuleBase | None = None,
        *,
        divergence: Literal["sampled", "gaussian"] = "sampled",
        distance: Literal["l2", "mico"] = "l2",
        regularizer: Literal["hinge", "literal", "none"] = "hinge",
        pairs: Literal["permuted", "all"] = "permuted",
        epsilon: float = 0.01,
        margin: float = 1.0,
        weight: float = 0.1,
        gamma: float = 0.95,
        reward_scale: float = 1.0,
        delay_encoder: bool = True,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        check_choice("divergence", divergence, ("sampled", "gaussian"))
        check_choice("distance", distance, tuple(_DISTANCES))
        check_choice("regularizer", regularizer, ("hinge", "literal", "none"))
        check_choice("pairs", pairs, ("permuted", "all"))
        check_choice("reduction", reduction, ("mean", "sum", "none"))
        check_flag(delay_encoder=delay_encoder)
        check_parts("encoder", encoder, TensorDictModuleBase, outputs=1)
        _check_divergence(divergence, distance, dynamics)
        check_real("[0, 1)", gamma=gamma)  # for distances to be finite
        check_real("[0, inf)", epsilon=epsilon, margin=margin, weight=weight)

        super().__init__()
        self.divergence, self.distance, self.pairs = divergence, distance, pairs
        self.regularizer, self.reduction = regularizer, reduction
        self.epsilon, self.margin, self.weight, self.gamma = epsilon, margin, weight, gamma
        self.register_coeff_buffer("reward_scale", float(reward_scale))
        self.convert_to_functional(encoder, "encoder", create_target_params=delay_encoder)
        if dynamics is not None:
            self.convert_to_functional(dynamics, "dynamics")
        self._set_in_keys()
        self.out_keys = [
            "loss_metric",
            *(["loss_regularizer"] if regularizer != "none" else []),
            *(["loss_dynamics"] if divergence == "gaussian" else []),
            "mean_distance",
            "mean_reward_difference",
            "effective_rank",
        ]

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        self.in_keys = [
            *self.encoder.in_keys,
            *(
                unravel_key(("next", key))
                for key in (*self.encoder.in_keys, keys.reward, keys.terminated)
            ),
        ]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The entries listed under ``Keys``, for a batch of any size, which is not modified."""
        embedding, next_embedding = embedded_ends(self, tensordict)
        samples, following = len(embedding), tensordict["next"]
        reward = read_scalars(self, following, self.tensor_keys.reward, samples)
        batch_size = reward.shape[:-1]
        reward = reward.detach().flatten() * self.reward_scale
        partner = partners(samples, reward.device, self.pairs)
        out: dict[str, Tensor] = {}
        if self.divergence == "gaussian":
            loc, scale = self._predict(tensordict)
            out["loss_dynamics"] = _dynamics_nll(next_embedding, loc, scale)
            loc, scale = loc.detach(), scale.detach()
            divergence = functional.gaussian_w2(
                loc.unsqueeze(1), scale.unsqueeze(1), loc[partner], scale[partner]
            )
        else:
            divergence = self._distance(next_embedding, partner)

        distance = self._distance(embedding, partner)
        rewards = reward.unsqueeze(1), reward[partner]
        target = functional.metric_target(*rewards, divergence, self.gamma)
        out["loss_metric"] = functional.metric_loss(distance, target).mean(1)
        if self.regularizer != "none":
            penalty = functional.discriminability(
                *rewards,
                embedding.unsqueeze(1),
                embedding[partner],
                self.epsilon,
                self.margin,
                self.regularizer,
            )
            out["loss_regularizer"] = self.weight * penalty.mean(1)

        reduced = {
            key: self._reduce_loss(value.reshape(batch_size), tensordict)
            for key, value in out.items()
        }
        return TensorDict(
            reduced
            | {
                "mean_distance": distance.detach().mean(),
                "mean_reward_difference": (rewards[0] - rewards[1]).abs().mean(),
                "effective_rank": functional.effective_rank(embedding.detach()),
            }
        )

    def _predict(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Predicted mean and standard deviation [samples, k] of the next target embedding."""
        with torch.no_grad():
            embedding = outputs(self.encoder, target_params(self), tensordict)
        inputs = TensorDict({self.dynamics.in_keys[0]: embedding}, embedding.shape[:-1])
        with self.dynamics_params.to_module(self.dynamics, preserve_module_state=False):
            written = self.dynamics(inputs)
        return written.get(self.dynamics.out_keys[0]), written.get(self.dynamics.out_keys[1])

    def _distance(self, embedding: Tensor, partner: Tensor) -> Tensor:
        """Distances [samples, pairs per sample]."""
        return _DISTANCES[self.distance](embedding.unsqueeze(1), embedding[partner])


def _check_divergence(divergence: str, distance: str, dynamics: object) -> None:
    """Check that dynamics and distance fit the divergence."""
    if divergence == "gaussian":
        if dynamics is None:
            raise ValueError(
                "divergence='gaussian' compares predicted next embeddings but dynamics is None; "
                "pass GaussianDynamics(embedding_dim) or choose divergence='sampled'."
            )
        check_parts("dynamics", dynamics, TensorDictModuleBase, outputs=2)
        if distance != "l2":
            raise ValueError(
                f"divergence='gaussian' is a Wasserstein distance over 'l2' but distance is "
                f"{distance!r}; choose distance='l2' or divergence='sampled'."
            )
    elif dynamics is not None:
        raise ValueError(
            "dynamics is given but divergence='sampled' does not read it; leave it out or choose "
            "divergence='gaussian'."
        )


def _dynamics_nll(value: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    """Negative log-likelihood [*] with every dimension weighted by its detached deviation.

    The gradient of the mean then grows as error / scale, instead of error / scale² (Seitzer et al.,
    2022, with beta = 1/2).
    """
    each = functional.gaussian_log_prob(*(x.unsqueeze(-1) for x in (value, loc, scale)))
    return -(scale.detach() * each).sum(-1)
