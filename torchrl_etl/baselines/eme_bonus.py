"""EME (Wang 2024), what it adds to the reward: how far a step moved in the learned metric."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_etl import functional
from torchrl_etl.baselines.eme import diversity_scale

__all__ = ["EMEBonus"]


class EMEBonus(Transform):
    """Rewards steps that are long in EME's metric, more so where the reward is not yet known.

    The same class works in three places: on an env, where every step writes the bonus; on a replay
    buffer, where every *sampled* batch gets the bonus of the current networks and nothing is
    written when the buffer is extended; and called on a tensordict with root and ``"next"``
    entries, any batch size, time included.

    Both networks are held by reference and belong to whoever trains them
    (:class:`~torchrl_etl.baselines.eme.EMELoss`): the transform evaluates them without gradients
    on their own device, and its ``state_dict()`` is empty. In another process they are the copies
    made when the worker started.

    Equation: ``b = d(s, s') min(max(Var_k r̂_k(s, a), 1), M)``, and ``r + weight b`` for the
    learner.

    Args:
        encoder (TensorDictModuleBase): φ, with one in-key and one out-key; d is the L2 distance of
            its embeddings. Its own key names need not be those of the data.
        ensemble (TensorDictModuleBase): reward predictors, with two in-keys (observation and
            action, in this order) and one out-key, one prediction for each member [*, K]. Likewise.

    Keyword Args:
        weight (float): of the bonus in the total reward. Default: 1.
        max_scale (float): M, at least 1. Default: 10.
        in_keys (sequence of NestedKey): keys of observation and action. Default:
            ``("observation", "action")``.
        out_keys (sequence of NestedKey): keys of bonus and total reward, both below ``"next"``.
            Default: ``("intrinsic_reward", "total_reward")``.
        reward_key (NestedKey): the task's reward, left as it is. Default: ``"reward"``.

    Keys:
        reads ``observation`` [*, O], ``action`` [*, n], ``("next", "observation")`` and
        ``("next", "reward")`` [*, 1]; writes ``("next", "intrinsic_reward")`` [*, 1], not negative,
        in units of the reward, and ``("next", "total_reward")`` [*, 1].

    Raises:
        TypeError: if a network has no in- and out-keys.
        ValueError: if a network has too many or too few of them, ``in_keys`` or ``out_keys`` is
            not a pair, ``max_scale`` is below 1 or ``weight`` is negative.
        KeyError: if an input is in neither the tensordict nor the specs of the env.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.baselines.eme import RewardEnsemble
        >>> from torchrl_etl.baselines.eme_bonus import EMEBonus
        >>> from torchrl_etl.modules import StateEncoder
        >>> bonus = EMEBonus(StateEncoder(3, 2), RewardEnsemble(3, 1), weight=0.1)
        >>> data = TensorDict({"observation": torch.randn(8, 3), "action": torch.randn(8, 1)}, [8])
        >>> data["next"] = {"observation": torch.randn(8, 3), "reward": torch.zeros(8, 1)}
        >>> bool((bonus(data)["next", "total_reward"] > 0).all())
        True
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> rollout = TransformedEnv(GymEnv("Pendulum-v1"), bonus).rollout(5)
        >>> rollout["next", "intrinsic_reward"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        encoder: TensorDictModuleBase,
        ensemble: TensorDictModuleBase,
        *,
        weight: float = 1.0,
        max_scale: float = 10.0,
        in_keys: Sequence[NestedKey] = ("observation", "action"),
        out_keys: Sequence[NestedKey] = ("intrinsic_reward", "total_reward"),
        reward_key: NestedKey = "reward",
    ) -> None:
        _check_keys("encoder", encoder, reads=("observation",))
        _check_keys("ensemble", ensemble, reads=("observation", "action"))
        for name, keys, content in (
            ("in_keys", in_keys, "the observation and the action"),
            ("out_keys", out_keys, "the bonus and the total reward"),
        ):
            if isinstance(keys, str) or len(keys) != 2:
                raise ValueError(f"{name} is {keys!r}; pass a pair of keys, {content}.")
        if max_scale < 1.0:
            raise ValueError(f"max_scale is {max_scale}; the scale is never below 1.")
        if weight < 0.0:
            raise ValueError(f"weight is {weight}; it must not be negative.")
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        # In a tuple they are no submodules: as such they would follow the env's device, be put in
        # eval mode under the learner's feet, and be saved twice.
        self._networks = (encoder, ensemble)
        self.weight, self.max_scale = weight, max_scale
        self.reward_key = unravel_key(reward_key)

    @property
    def encoder(self) -> TensorDictModuleBase:
        """The encoder given at construction, not a copy."""
        return self._networks[0]

    @property
    def ensemble(self) -> TensorDictModuleBase:
        """The ensemble given at construction, not a copy."""
        return self._networks[1]

    @torch.no_grad()
    def _rewards(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        observation_key, action_key = self.in_keys
        observation = _read(tensordict, observation_key)
        action = _read(tensordict, action_key)
        next_observation = _read(next_tensordict, observation_key, "next")
        reward = _read(next_tensordict, self.reward_key, "next")
        # One pass through the encoder for both ends of the transition.
        ends = _evaluate(self.encoder, torch.stack([observation, next_observation]))
        distance = functional.l2_distance(*ends.unbind(0)).unsqueeze(-1)
        scale = diversity_scale(_evaluate(self.ensemble, observation, action), self.max_scale)
        bonus = distance.to(reward.device) * scale.to(reward.device)
        return bonus, reward + self.weight * bonus

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict = tensordict.get("next", None)
        if next_tensordict is None:
            raise KeyError(
                "EMEBonus needs whole transitions, but the tensordict has no 'next' entry; call it "
                "on data from a rollout, a collector or a replay buffer."
            )
        rewards = self._rewards(tensordict, next_tensordict)
        for key, value in zip(self.out_keys, rewards, strict=True):
            tensordict.set(unravel_key(("next", key)), value)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rewards = self._rewards(tensordict, next_tensordict)
        for key, value in zip(self.out_keys, rewards, strict=True):
            next_tensordict.set(key, value)
        return next_tensordict

    def transform_state_spec(self, state_spec: Composite | None) -> Composite:
        # A parallel env hands its workers the action and what the state spec names, no more:
        # without this entry a worker would take the root of its own last step for the caller's.
        if state_spec is None:
            state_spec = Composite(shape=self.parent.batch_size, device=self.parent.device)
        if self.in_keys[0] not in state_spec.keys(True, True):
            state_spec[self.in_keys[0]] = self._observation_leaf().clone()
        return state_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        leaf = self._observation_leaf()
        for key in self.out_keys:
            reward_spec[key] = Unbounded(
                shape=(*leaf.shape[:-1], 1), dtype=leaf.dtype, device=leaf.device
            )
        return reward_spec

    def _observation_leaf(self) -> Unbounded:
        observation_spec = self.parent.full_observation_spec
        if self.in_keys[0] not in observation_spec.keys(True, True):
            raise KeyError(
                f"EMEBonus reads {self.in_keys[0]!r}, but the env's observations are "
                f"{sorted(map(str, observation_spec.keys(True, True)))}; name the right one in "
                "in_keys."
            )
        return observation_spec[self.in_keys[0]]


def _check_keys(name: str, module: TensorDictModuleBase, reads: Sequence[str]) -> None:
    if not (hasattr(module, "in_keys") and hasattr(module, "out_keys")):
        raise TypeError(
            f"The {name} is a {type(module).__name__} without in_keys and out_keys; wrap it in a "
            "tensordict.nn.TensorDictModule."
        )
    if len(module.in_keys) != len(reads) or len(module.out_keys) != 1:
        raise ValueError(
            f"The {name} reads {list(module.in_keys)} and writes {list(module.out_keys)}; it must "
            f"read {' and '.join(reads)}, and write one key."
        )


def _read(tensordict: TensorDictBase, key: NestedKey, *prefix: str) -> Tensor:
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(
            f"EMEBonus reads {unravel_key((*prefix, key))!r}, which the data lacks; beside it are "
            f"{sorted(map(str, tensordict.keys(True, True)))}."
        )
    return value


def _evaluate(network: TensorDictModuleBase, *inputs: Tensor) -> Tensor:
    """The network's output for bare tensors, computed on the network's own device."""
    device = next(iter(network.parameters()), inputs[0]).device
    entries = dict(zip(network.in_keys, inputs, strict=True))
    written = network(TensorDict(entries, inputs[0].shape[:-1], device=device))
    return written.get(network.out_keys[0])
