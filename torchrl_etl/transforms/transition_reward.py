"""Rewards of whole transitions for environments, buffers and tensordicts."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded

from torchrl_etl.objectives.checks import read
from torchrl_etl.transforms.keys import SoleWriter, private_key, set_leaf, set_where_reset

__all__ = ["TransitionReward", "evaluate"]


class TransitionReward(SoleWriter):
    """Writes rewards below ``"next"`` that depend on both ends of a transition.

    The first in-key is the observation at both ends. In an environment, later transforms may
    rewrite it (a normalization, say, perhaps in another process). Then the root of a step and its
    ``"next"`` would not be comparable. So the transform carries its own copy from step to step,
    under a private key that collectors leave out of batches.

    A subclass computes one reward for each out-key in ``_rewards``. Rewards are declared as [*, 1]
    with the dtype of ``_typed_by``.
    """

    _remedy: str
    """Remedy in the error about an observation that an environment lacks."""

    @property
    def networks(self) -> Sequence[nn.Module]:
        """Networks that it reads but does not own: others train and save them."""
        return ()

    @property
    def _state_keys(self) -> Sequence[NestedKey]:
        """In-keys, besides the first, that the env's state spec must contain."""
        return ()

    @property
    @abstractmethod
    def _typed_by(self) -> NestedKey:
        """Observation or reward whose dtype and device the rewards have."""

    @abstractmethod
    def _rewards(
        self,
        observation: Tensor,
        next_observation: Tensor,
        tensordict: TensorDictBase,
        next_tensordict: TensorDictBase,
    ) -> tuple[Tensor, ...]:
        """The rewards [*, 1], in the order of the out-keys."""

    @property
    def _copy_key(self) -> NestedKey:
        return private_key(self.out_keys[0], self.in_keys[0])

    def _read(self, tensordict: TensorDictBase, key: NestedKey, *prefix: str) -> Tensor:
        return read(type(self).__name__, tensordict, key, *prefix)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict = tensordict.get("next", None)
        if next_tensordict is None:
            raise KeyError(
                f"{type(self).__name__} needs whole transitions, but the tensordict has no 'next' "
                "entry; call it on data from a rollout, a collector or a replay buffer."
            )
        # Both ends have passed the same transforms here.
        key = self.in_keys[0]
        ends = self._read(tensordict, key), self._read(next_tensordict, key, "next")
        rewards = self._rewards(*ends, tensordict, next_tensordict)
        for key, value in zip(self.out_keys, rewards, strict=True):
            tensordict.set(unravel_key(("next", key)), value)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._keep(next_tensordict)
        ends = self._read(tensordict, self._copy_key), next_tensordict.get(self._copy_key)
        rewards = self._rewards(*ends, tensordict, next_tensordict)
        for key, value in zip(self.out_keys, rewards, strict=True):
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._leaf(self.in_keys[0])  # raises if the environment has no such key
        return self._keep(tensordict_reset)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        fresh = self._read(tensordict_reset, self.in_keys[0])
        return set_where_reset(self.parent, tensordict, tensordict_reset, self._copy_key, fresh)

    def _keep(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(self._copy_key, self._read(tensordict, self.in_keys[0]).clone())

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        leaf = self._leaf(self.in_keys[0]).clone()
        set_leaf(observation_spec, self._copy_key, leaf, self.parent)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite | None) -> Composite:
        # A parallel env sends its workers only the action and the entries of the state spec.
        # Without these, a worker would use the root of its own last step, not the caller's.
        if state_spec is None:
            state_spec = Composite(shape=self.parent.batch_size, device=self.parent.device)
        set_leaf(state_spec, self._copy_key, self._leaf(self.in_keys[0]).clone(), self.parent)
        for key in self._state_keys:
            if key not in state_spec.keys(True, True):
                set_leaf(state_spec, key, self._leaf(key).clone(), self.parent)
        return state_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        observation, typed = self._leaf(self.in_keys[0]), self._leaf(self._typed_by)
        for key in self.out_keys:
            leaf = Unbounded(
                shape=(*observation.shape[:-1], 1), dtype=typed.dtype, device=typed.device
            )
            set_leaf(reward_spec, key, leaf, self.parent)
        return reward_spec

    def _leaf(self, key: NestedKey) -> TensorSpec:
        for spec in (self.parent.full_observation_spec, self.parent.full_reward_spec):
            if key in spec.keys(True, True):
                return spec[key]
        observed = sorted(map(str, self.parent.full_observation_spec.keys(True, True)))
        raise KeyError(
            f"{type(self).__name__} reads {key!r}, but the env's observations are {observed}; "
            f"{self._remedy}"
        )


def evaluate(network: TensorDictModuleBase, *inputs: Tensor) -> Tensor:
    """The network's output for plain tensors, computed on the network's device and dtype."""
    weight = next(iter(network.parameters()), inputs[0])
    entries = {key: value.to(weight) for key, value in zip(network.in_keys, inputs, strict=True)}
    written = network(TensorDict(entries, inputs[0].shape[:-1], device=weight.device))
    return written.get(network.out_keys[0])
