"""Rewards of whole transitions, on environments, buffers and tensordicts alike."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

__all__ = ["TransitionReward", "evaluate"]


class TransitionReward(Transform):
    """Writes rewards below ``"next"`` that depend on both ends of a step.

    A subclass computes them in ``_rewards``, one for each out-key. They are declared as [*, 1], of
    the dtype of the last observation that is read.
    """

    _cure: str
    """How to mend that an observation is missing in an environment."""

    @property
    def _observed(self) -> Sequence[NestedKey]:
        """Those in-keys that are observations."""
        return self.in_keys

    @abstractmethod
    def _rewards(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> tuple[Tensor, ...]:
        """The rewards [*, 1], in the order of the out-keys."""

    def _read(self, tensordict: TensorDictBase, key: NestedKey, *prefix: str) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(
                f"{type(self).__name__} reads {unravel_key((*prefix, key))!r}, which the data "
                f"lacks; beside it are {sorted(map(str, tensordict.keys(True, True)))}."
            )
        return value

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict = tensordict.get("next", None)
        if next_tensordict is None:
            raise KeyError(
                f"{type(self).__name__} needs whole transitions, but the tensordict has no 'next' "
                "entry; call it on data from a rollout, a collector or a replay buffer."
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
        # without these entries a worker would take the root of its own last step for the caller's.
        if state_spec is None:
            state_spec = Composite(shape=self.parent.batch_size, device=self.parent.device)
        for key in self._observed:
            if key not in state_spec.keys(True, True):
                state_spec[key] = self._observation_leaf(key).clone()
        return state_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        leaf = self._observation_leaf(self._observed[-1])
        for key in self.out_keys:
            reward_spec[key] = Unbounded(
                shape=(*leaf.shape[:-1], 1), dtype=leaf.dtype, device=leaf.device
            )
        return reward_spec

    def _observation_leaf(self, key: NestedKey) -> Unbounded:
        observation_spec = self.parent.full_observation_spec
        if key not in observation_spec.keys(True, True):
            raise KeyError(
                f"{type(self).__name__} reads {key!r}, but the env's observations are "
                f"{sorted(map(str, observation_spec.keys(True, True)))}; {self._cure}"
            )
        return observation_spec[key]


def evaluate(network: TensorDictModuleBase, *inputs: Tensor) -> Tensor:
    """The network's output for bare tensors, computed on the network's own device."""
    device = next(iter(network.parameters()), inputs[0]).device
    entries = dict(zip(network.in_keys, inputs, strict=True))
    written = network(TensorDict(entries, inputs[0].shape[:-1], device=device))
    return written.get(network.out_keys[0])
