"""EME's loss (Wang 2024): a state metric that also compares the policy between states."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import distance_loss

from torchrl_etl import functional
from torchrl_etl.checks import check_choice, check_real
from torchrl_etl.draws import standard_uniform
from torchrl_etl.objectives.behavioral_metric import BehavioralMetricLoss
from torchrl_etl.objectives.checks import check_parts
from torchrl_etl.objectives.pairs import embedded_ends, outputs, partners, read_scalars

__all__ = ["EMELoss"]


class EMELoss(LossModule):
    r"""Loss that trains EME's metric, as distances of state embeddings, and its reward ensemble.

    Each transition is paired with one other of the batch. The distance of their embeddings
    regresses to their reward difference, plus ``gamma`` times the distance of their next states,
    plus the KL divergence of the policy between their states. Both networks are used for the bonus
    in :class:`~torchrl_etl.baselines.eme_bonus.EMEBonus`.

    Equation: ``d(s_i, s_j) = |r_i - r_j| + gamma d(s'_i, s'_j) + KL(pi_i ‖ pi_j)``, regressed with
    the right side held fixed; each member of the ensemble regresses the reward.

    Keys:
        reads the ``in_keys`` of encoder, actor and ensemble (``observation`` [*, O] and ``action``
        [*, n]), those of the encoder below ``"next"``, ``("next", "reward")`` [*, 1] and
        ``("next", "terminated")`` [*, 1] bool. Writes

        - ``loss_metric``: error of the distances;
        - ``loss_reward_ensemble``: squared error of the predictions, mean over members;
        - ``mean_distance``, ``mean_reward_difference``, ``mean_policy_divergence`` (nats): over the
          pairs, detached;
        - ``mean_reward_variance``: between the members, before EME clamps it, detached;
        - ``effective_rank``: of the embeddings, detached; near 1 means one used dimension.

    Deviates:
        - The public code never trains the metric; this is the paper's, for any learner with a
          Gaussian policy below a tanh. The paper's learner is PPO in some tables. For Robosuite,
          a soft-update weight and a learning rate of α suggest one like SAC.
        - d is the L2 distance of embeddings. Unlike a free network of both states, it is symmetric
          and zero between a state and itself. KL is not symmetric: since both orders of a pair are
          equally likely, d settles between KL(pi_i ‖ pi_j) and KL(pi_j ‖ pi_i).
        - The next states' distance uses a target encoder, and all terminated next states are one
          absorbing state at the origin, as in
          :class:`~torchrl_etl.objectives.BehavioralMetricLoss`. EME is compared with ETL, so
          whatever is not EME's own follows ETL.
        - The error is smooth-L1, since the divergence of nearly deterministic policies runs to
          hundreds of nats; ``loss_function="l2"`` is the squared error.
        - Other reimplementations of EME read its target as ``policy_weight=gamma`` and
          ``reward_difference="corrected"``. The latter subtracts the ensemble's variances of both
          rewards from the squared difference.

    Args:
        encoder (TensorDictModule): φ; its first out key is the embedding [*, k].
        ensemble (TensorDictModule): the reward predictors, such as
            :class:`~torchrl_etl.baselines.reward_ensemble.RewardEnsemble`; its first out key holds
            one prediction for each member [*, K].
        actor (ProbabilisticTensorDictSequential): the policy that is being learned, held by
            reference. It gets no gradient and is not in the loss's ``parameters()`` or
            ``state_dict()``.

    Keyword Args:
        gamma (float): discount factor in [0, 1); use the learner's, since the metric is a
            discounted return. Default: ``0.95``.
        policy_weight (float): weight of the policy's divergence. Default: ``1.0``.
        reward_difference (str): ``"sampled"`` or ``"corrected"``. Default: ``"sampled"``.
        loss_function (str): ``"smooth_l1"`` or ``"l2"``, of the distances.
            Default: ``"smooth_l1"``.
        subset_share (float): in (0, 1]; expected share of each batch that a member learns from, its
            own random subset. Members also differ by initialization. Default: ``0.8``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Default: ``"mean"``.

    Raises:
        ValueError: at construction for an unknown choice, a number out of range, or an actor that
            does not write ``loc`` and ``scale``; in ``forward`` for a batch of one sample, which
            has no pairs.
        TypeError: if a network is not a TensorDict module, or the actor not a probabilistic one.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_etl.baselines import EMELoss, RewardEnsemble
        >>> from torchrl_etl.modules import StateEncoder, make_actor
        >>> actor = make_actor({"observation": 7}, Bounded(-1, 1, shape=(5,)))
        >>> loss = EMELoss(StateEncoder(7, 4), RewardEnsemble(7, 5), actor)
        >>> updater = SoftUpdate(loss, tau=0.01)
        >>> entries = {"observation": torch.randn(32, 7), "action": torch.rand(32, 5)}
        >>> batch = TensorDict(entries, [32])
        >>> batch["next"] = {
        ...     "observation": torch.randn(32, 7),
        ...     "reward": torch.randn(32, 1),
        ...     "terminated": torch.zeros(32, 1, dtype=torch.bool),
        ... }
        >>> out = loss(batch)
        >>> (out["loss_metric"] + out["loss_reward_ensemble"]).backward()
        >>> updater.step()
    """

    _AcceptedKeys = BehavioralMetricLoss._AcceptedKeys  # both metrics read the same keys
    default_keys = _AcceptedKeys
    tensor_keys: BehavioralMetricLoss._AcceptedKeys

    encoder: TensorDictModuleBase
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    ensemble: TensorDictModuleBase
    ensemble_params: TensorDictParams
    target_ensemble_params: TensorDictParams

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        ensemble: TensorDictModuleBase,
        actor: ProbabilisticTensorDictSequential,
        *,
        gamma: float = 0.95,
        policy_weight: float = 1.0,
        reward_difference: Literal["sampled", "corrected"] = "sampled",
        loss_function: Literal["smooth_l1", "l2"] = "smooth_l1",
        subset_share: float = 0.8,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        check_choice("reward_difference", reward_difference, ("sampled", "corrected"))
        check_choice("loss_function", loss_function, ("smooth_l1", "l2"))
        check_choice("reduction", reduction, ("mean", "sum", "none"))
        check_parts("encoder", encoder, TensorDictModuleBase, outputs=1)
        check_parts("ensemble", ensemble, TensorDictModuleBase, outputs=1)
        check_parts("actor", actor, ProbabilisticTensorDictSequential)
        if not {"loc", "scale"} <= set(actor.out_keys):
            raise ValueError(
                f"The actor writes {list(actor.out_keys)}; it must write its Gaussian's mean and "
                "standard deviation as loc and scale, as make_actor's does."
            )
        check_real("[0, 1)", gamma=gamma)  # for distances to be finite
        check_real("[0, inf)", policy_weight=policy_weight)
        check_real("(0, 1]", subset_share=subset_share)

        super().__init__()
        self.gamma, self.policy_weight, self.subset_share = gamma, policy_weight, subset_share
        self.reward_difference, self.loss_function = reward_difference, loss_function
        self.reduction = reduction
        # In a tuple, so that the actor is no submodule: training, saving, casting or resetting the
        # loss leaves it alone.
        self._actor = (actor,)
        self.convert_to_functional(encoder, "encoder", create_target_params=True)
        self.convert_to_functional(ensemble, "ensemble")
        self._set_in_keys()
        self.out_keys = [
            "loss_metric",
            "loss_reward_ensemble",
            "mean_distance",
            "mean_reward_difference",
            "mean_policy_divergence",
            "mean_reward_variance",
            "effective_rank",
        ]

    @property
    def actor(self) -> ProbabilisticTensorDictSequential:
        """The actor given at construction, not a copy."""
        return self._actor[0]

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        following = (*self.encoder.in_keys, keys.reward, keys.terminated)
        parts = (self.encoder, self.actor, self.ensemble)
        # Several parts read the observation: a dictionary keeps each key once, in order.
        present = dict.fromkeys(key for part in parts for key in part.in_keys)
        self.in_keys = [*present, *(unravel_key(("next", key)) for key in following)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The entries listed under ``Keys``, for a batch of any size, which is not modified."""
        embedding, next_embedding = embedded_ends(self, tensordict)
        key = self.tensor_keys.reward
        reward = read_scalars(self, tensordict["next"], key, len(embedding))
        batch_size = reward.shape[:-1]
        reward = reward.detach().flatten()
        partner = partners(reward.numel(), reward.device).squeeze(1)

        predictions = outputs(self.ensemble, self.ensemble_params, tensordict)
        with torch.no_grad():
            loc, scale = self._gaussian(tensordict, like=embedding)
            divergence = functional.gaussian_kl(loc, scale, loc[partner], scale[partner])
            variance = predictions.var(-1, correction=0)
            difference = self._difference(reward, variance, partner)
            target = (
                difference
                + self.gamma * functional.l2_distance(next_embedding, next_embedding[partner])
                + self.policy_weight * divergence
            )

        distance = functional.l2_distance(embedding, embedding[partner])
        error = (predictions - reward.unsqueeze(-1)).square()
        if self.subset_share < 1.0:
            drawn = standard_uniform(error) < self.subset_share
            error = error * drawn / self.subset_share
        out = {
            "loss_metric": distance_loss(distance, target, self.loss_function),
            "loss_reward_ensemble": error.mean(-1),
        }
        reduced = {
            key: self._reduce_loss(value.reshape(batch_size), tensordict)
            for key, value in out.items()
        }
        return TensorDict(
            reduced
            | {
                "mean_distance": distance.detach().mean(),
                "mean_reward_difference": difference.mean(),
                "mean_policy_divergence": divergence.mean(),
                "mean_reward_variance": variance.mean(),
                "effective_rank": functional.effective_rank(embedding.detach()),
            }
        )

    def _difference(self, reward: Tensor, variance: Tensor, partner: Tensor) -> Tensor:
        """Reward difference of each pair [samples]."""
        difference = (reward - reward[partner]).abs()
        if self.reward_difference == "corrected":
            noise = variance + variance[partner]
            difference = (difference.square() - noise).clamp_min(0.0).sqrt()
        return difference

    def _gaussian(self, tensordict: TensorDictBase, like: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation [samples, n] of the actor below its tanh.

        An invertible map of both Gaussians does not change their divergence, so the tanh and the
        bounds of the action do not matter.
        """
        # The loss may have been cast without the actor. Cast entry by entry: torch.compile (2.13)
        # cannot trace TensorDict.to.
        parameter = next(self.actor.parameters(), like)
        entries = {key: tensordict.get(key).to(parameter) for key in self.actor.in_keys}
        inputs = TensorDict(entries, tensordict.batch_size)
        written = self.actor.get_dist_params(inputs)
        loc, scale = (written.get(key).flatten(0, -2).to(like) for key in ("loc", "scale"))
        return loc, scale
