"""Eq. 1 as a transform: the reward for moving along the episode's direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_etl.functional import direction_bonus
from torchrl_etl.transforms.keys import check_network
from torchrl_etl.transforms.scaled_bonus import ScaledBonus
from torchrl_etl.transforms.transition_reward import evaluate

__all__ = ["IntrinsicReward"]


class IntrinsicReward(ScaledBonus):
    """Rewards movement of the state embedding along the direction of the episode.

    The same class works in four places:

    - on an env: every step writes the bonus, for logging or on-policy learners. The env's state
      spec then holds the direction and a private copy of the observation, so that later transforms
      of the observation do not change the bonus;
    - on a replay buffer: every *sampled* batch gets the bonus of the current encoder, so the reward
      is never stale. Nothing is written when the buffer is extended;
    - among the transforms of a :class:`~torchrl_etl.learners.SACLearner`: the same, inside the
      compiled update;
    - called on a tensordict with root and ``"next"`` entries, of any batch size, including time.

    In a group of agents each has its own bonus; a direction outside the group is shared by all.
    With n-step returns, a bonus on the environment must be named as a reward:
    ``MultiStepTransform(..., reward_keys=["reward", "intrinsic_reward"])``, or the attribute
    ``reward_keys`` of ``MultiStep``. On a buffer, the bonus of an n-step transition is computed
    from its two ends and equals the undiscounted sum over its steps.

    The encoder is held by reference. It is evaluated without gradients on its own device, and the
    transform never copies, moves or freezes it or changes its train or eval mode. ``state_dict()``
    holds only the running statistics. In another process the encoder is the copy made when the
    worker started.

    Equation: 1, r^b = ⟨φ(s') - φ(s), z_sp⟩.

    Deviates: Eq. 1 is the bare bonus, whose scale drifts with φ. By default the bonus, and the
    task's reward if added, are divided by their running standard deviations, at least a tenth of
    their root mean squares. No mean is subtracted, since the sign says towards or away.
    ``normalize=False`` is as printed. By default the reward is the bonus alone, as in Algorithm 1;
    ``extrinsic_weight=1`` is the text's r^e + r^b.

    Args:
        encoder (TensorDictModuleBase): φ, with one in-key and one out-key. Its key names may differ
            from the data's.

    Keyword Args:
        in_keys (sequence of NestedKey): keys of observation and direction. Default:
            ``("observation", "direction")``.
        out_key (NestedKey): Default: ``"intrinsic_reward"``.
        **scale: ``normalize``, ``decay``, ``extrinsic_weight``, ``reward_key`` and
            ``update_statistics``, see :class:`~torchrl_etl.transforms.ScaledBonus`.

    Keys:
        reads ``observation`` [*, O], ``direction`` [*, k], ``("next", "observation")`` and, with an
        extrinsic weight, ``("next", "reward")`` [*, 1]; writes ``("next", "intrinsic_reward")``
        [*, 1], unbounded, in standard deviations where normalized.

    Raises:
        TypeError: if the encoder has no in- and out-keys.
        ValueError: if the encoder has several of them, ``in_keys`` is not a pair, or ``decay`` is
            outside (0, 1); at the first call if embedding and direction differ in size.
        ValueError: when attached, if something else also writes ``out_key``.
        KeyError: if an input is in neither the tensordict nor the specs of the env.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import StateEncoder
        >>> from torchrl_etl.transforms import IntrinsicReward
        >>> encoder = StateEncoder(observation_dim=3, embedding_dim=2)
        >>> bonus = IntrinsicReward(encoder)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 3),
        ...         "direction": torch.eye(2)[torch.randint(2, (8,))],
        ...         "next": {"observation": torch.randn(8, 3)},
        ...     },
        ...     [8],
        ... )
        >>> bonus(data)["next", "intrinsic_reward"].shape
        torch.Size([8, 1])
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_etl.transforms import DirectionPrimer
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), DirectionPrimer(2))
        >>> rollout = env.append_transform(IntrinsicReward(encoder)).rollout(5)
        >>> rollout["next", "intrinsic_reward"].shape
        torch.Size([5, 1])
    """

    encoder: TensorDictModuleBase
    """The encoder given at construction, not a copy."""

    _remedy = (
        "put the transform that writes it (DirectionPrimer for the direction) before "
        "IntrinsicReward."
    )

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        *,
        in_keys: Sequence[NestedKey] = ("observation", "direction"),
        out_key: NestedKey = "intrinsic_reward",
        **scale: Any,
    ) -> None:
        check_network("encoder", encoder, ["one observation"], "one embedding")
        if isinstance(in_keys, str) or len(in_keys) != 2:
            raise ValueError(
                f"in_keys is {in_keys!r}; pass a pair of keys, the observation and the direction."
            )
        super().__init__(in_keys, out_key, **scale)
        # Not a submodule: it would follow the env's device, be put in eval mode while the learner
        # uses it, and be saved twice.
        self.__dict__["encoder"] = encoder

    @property
    def networks(self) -> Sequence[nn.Module]:
        return (self.encoder,)

    @property
    def _state_keys(self) -> Sequence[NestedKey]:
        return self.in_keys[1:]

    @property
    def _typed_by(self) -> NestedKey:
        return self.in_keys[1]

    def _bonus(
        self, observation: Tensor, next_observation: Tensor, tensordict: TensorDictBase
    ) -> Tensor:
        direction_key = self.in_keys[1]
        direction = self._read(tensordict, direction_key)
        # Each end separately: a compiled update reuses the first one from the encoder's loss.
        ends = observation, next_observation
        embedding, next_embedding = (evaluate(self.encoder, end).to(direction) for end in ends)
        if embedding.shape[-1] != direction.shape[-1]:
            raise ValueError(
                f"The encoder's embedding has {embedding.shape[-1]} dimensions but "
                f"{direction_key!r} has {direction.shape[-1]}; give DirectionPrimer and encoder "
                "the same embedding_dim."
            )
        while direction.ndim < embedding.ndim:  # one direction for a group of agents
            direction = direction.unsqueeze(-2)
        return direction_bonus(embedding, next_embedding, direction.expand_as(embedding))
