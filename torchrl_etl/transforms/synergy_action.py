"""The synergy decoder as an action-mapping transform: the policy acts in d dimensions, not n."""

from __future__ import annotations

import sys
import warnings
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, ReplayBuffer, TensorSpec, Unbounded
from torchrl.envs.transforms import ModuleTransform, TransformedEnv

from torchrl_etl.transforms.keys import group_reset, private_key, set_leaf

if TYPE_CHECKING:
    from torchrl.envs import EnvBase
    from torchrl.envs.transforms import Transform

__all__ = ["SynergyAction"]


class SynergyAction(ModuleTransform):
    """Lets a policy act through a synergy decoder.

    The action spec of the transformed env is the decoder's ``synergy_spec``; at each step the
    inverse pass decodes the synergy into the action that the env executes, without gradients.

    In a collector's batches root ``synergy`` and root ``action`` belong together, as they would if
    the policy ended in the decoder, and stay together under n-step returns. What the simulator
    executed in the end, after clips and scalings between it and this transform, is
    ``("next", "executed_action")``; root ``executed_action`` is that of the step before.

    ``env.step``, ``env.rollout`` and the workers of ``SerialEnv`` and ``ParallelEnv`` cannot write
    to the root, and leave ``action`` out. There the pair is root ``synergy`` and
    ``("next", "executed_action")``, and before n-step returns
    ``RenameTransform([("next", "executed_action")], ["action"], create_copy=True)`` brings it to
    the root.

    The decoder is held by reference: changing its weights in place changes the next step. It is a
    submodule, so ``state_dict()`` holds it and attaching moves it to the env's device and to eval
    mode, as TorchRL does with every module; give a copy where the learner trains its own. In
    another process the decoder is the copy made when the worker started.

    Replay buffers call a transform's inverse on ``extend``; attached to one, SynergyAction would
    overwrite recorded actions, so it refuses.

    Equation: a = Dec(z^a) of section 4.2.

    Args:
        decoder (TensorDictModuleBase): one in-key, one out-key and the attributes ``synergy_spec``
            (unbatched), ``action_dim``, ``low`` and ``high`` of
            :class:`~torchrl_etl.modules.SynergyDecoder`.

    Keyword Args:
        synergy_key (NestedKey): what the policy writes. ``"action"`` serves policies that know no
            other key; the recorded ``"action"`` is then the synergy. Default: ``"synergy"``.
        executed_key (NestedKey): where the executed action is recorded.
            Default: ``"executed_action"``.
        action_key (NestedKey, optional): the base env's action. Default: the decoder's out-key.
        decoded_key (NestedKey, optional): where a collector's batch has the decoded action.
            Default: ``action_key``, and ``"decoded_action"`` beside it where the synergy is there.

    Keys:
        reads ``synergy`` [*, d] in [-1, 1]; writes ``("next", "executed_action")``, of the base
        env's action spec, at reset ``executed_action``, zeros brought into the bounds, and, under a
        collector, ``action`` [*, n] in [low, high]. In a group of agents all of them lie in the
        group, if their keys say so.

    Raises:
        TypeError: if the decoder lacks keys or attributes, or the transform meets a replay buffer.
        ValueError: if keys collide; when attached to an env, if the env has no such action key or
            its number of actuators or bounds are not the decoder's.
        RuntimeError: if called forward: there is no way back from actions to synergies here.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> from torchrl_etl.transforms import SynergyAction
        >>> decoder = SynergyDecoder(1, 1, low=-2.0, high=2.0)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), SynergyAction(decoder))
        >>> env.action_keys
        ['synergy']
        >>> rollout = env.rollout(3)
        >>> executed = rollout["next", "executed_action"]
        >>> torch.allclose(executed, decoder(rollout["synergy"]))
        True
    """

    def __init__(
        self,
        decoder: TensorDictModuleBase,
        *,
        synergy_key: NestedKey = "synergy",
        executed_key: NestedKey = "executed_action",
        action_key: NestedKey | None = None,
        decoded_key: NestedKey | None = None,
    ) -> None:
        needed = ("in_keys", "out_keys", "synergy_spec", "action_dim", "low", "high")
        missing = [name for name in needed if not hasattr(decoder, name)]
        if missing:
            raise TypeError(
                f"The decoder is a {type(decoder).__name__} without {', '.join(missing)}; pass a "
                "torchrl_etl.modules.SynergyDecoder or a TensorDictModule that has them."
            )
        if len(decoder.in_keys) != 1 or len(decoder.out_keys) != 1:
            raise ValueError(
                f"The decoder reads {list(decoder.in_keys)} and writes {list(decoder.out_keys)}; "
                "it must read one synergy and write one action."
            )
        super().__init__(module=decoder, inverse=True, no_grad=True)
        self.synergy_key = unravel_key(synergy_key)
        self.executed_key = unravel_key(executed_key)
        self.action_key = unravel_key(decoder.out_keys[0] if action_key is None else action_key)
        if decoded_key is None:
            taken = self.action_key == self.synergy_key
            decoded_key = _beside(self.action_key, "decoded_action") if taken else self.action_key
        self.decoded_key = unravel_key(decoded_key)
        if self.executed_key in (self.synergy_key, self.action_key):
            raise ValueError(
                f"executed_key is {self.executed_key!r}, which already names the synergy or the "
                "action; choose a key of its own, such as 'executed_action'."
            )
        if self.decoded_key in (self.synergy_key, self.executed_key):
            raise ValueError(
                f"decoded_key is {self.decoded_key!r}, which already names the synergy or the "
                "executed action; choose a key of its own, such as 'decoded_action'."
            )

    def _in_keys_inv(self) -> list[NestedKey]:
        return [self.action_key]

    def _out_keys_inv(self) -> list[NestedKey]:
        return [self.synergy_key]

    @property
    def _decoded_copy(self) -> NestedKey:
        # Seen by ``_step`` only. The action key will not do: an inner transform, such as an action
        # scaling, rewrites it on the way to the env.
        return private_key(self.executed_key, self.decoded_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        synergy = tensordict.get(self.synergy_key, None)
        if synergy is None:
            if self.missing_tolerance:
                return tensordict
            raise KeyError(
                f"SynergyAction reads {self.synergy_key!r}, but the tensordict has only "
                f"{sorted(map(str, tensordict.keys(True, True)))}; let the policy write it."
            )
        action = self.decode(synergy)
        tensordict.set(self.action_key, action)
        return tensordict.set(self._decoded_copy, action)

    @torch.no_grad()
    def decode(self, synergy: Tensor) -> Tensor:
        """Actions [*, n] for coefficients [*, d], in the env's dtype."""
        decoder = self.module
        entry = TensorDict({decoder.in_keys[0]: synergy}, synergy.shape[:-1])
        action = decoder(entry).get(decoder.out_keys[0])
        return action if self.parent is None else action.to(self._action_leaf.dtype)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "SynergyAction acts in the inverse pass of an env only; to decode synergies elsewhere "
            "call its inv(tensordict) or the decoder itself."
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # ``tensordict`` is the copy that the inverse passes of all transforms worked on.
        decoded = tensordict.get(self._decoded_copy)
        if isinstance(self.collector, Collector):
            # The copy's root is lost, and so is that of the step where a collector takes data from
            # device to device; this is the one that it stores.
            self.collector._carrier.set(self.decoded_key, decoded)
        executed = decoded if self._base_key is None else tensordict.get(self._base_key)
        return next_tensordict.set(self.executed_key, executed.to(self._executed_leaf.dtype))

    def transform_fake_tensordict(self, fake_tensordict: TensorDictBase) -> TensorDictBase:
        if isinstance(self.collector, Collector):
            fake_tensordict.set(self.decoded_key, self._action_leaf.zero())
        return fake_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.set(self.executed_key, self.rest(tensordict_reset.batch_size))

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Here nobody merges by the reset mask for us.
        rest = self.rest(tensordict_reset.batch_size)
        reset = group_reset(self.parent, tensordict, self.executed_key)
        present = tensordict.get(self.executed_key)
        return tensordict_reset.set(
            self.executed_key, torch.where(expand_as_right(reset, rest), rest, present)
        )

    def rest(self, batch_size: torch.Size) -> Tensor:
        """What counts as executed before the first step: zeros brought into the bounds."""
        leaf = self._executed_leaf
        rest = leaf.zero()
        if isinstance(leaf, Bounded):
            rest = rest.clamp(leaf.space.low, leaf.space.high)
        # An env that is not batch-locked leaves the batch size to the data.
        return rest.expand(*batch_size, *rest.shape[self.parent.ndim :]).clone()

    @property
    def _action_leaf(self) -> TensorSpec:
        return self.parent.full_action_spec[self.action_key]

    @property
    def _base_key(self) -> NestedKey | None:
        """The simulator's name for the action, or None where that is not known."""
        keys = self.parent.base_env.action_keys
        if self.action_key in keys:
            return self.action_key
        return keys[0] if len(keys) == 1 else None

    @property
    def _executed_leaf(self) -> TensorSpec:
        key = self._base_key
        return self._action_leaf if key is None else self.parent.base_env.full_action_spec[key]

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        leaf = action_spec[self.action_key]
        synergy_spec = self.module.synergy_spec
        synergy_spec = synergy_spec.expand(*leaf.shape[:-1], *synergy_spec.shape)
        synergy_spec = synergy_spec.to(leaf.device or synergy_spec.device)
        # In this order: a group that were empty for a moment would lose its batch size.
        set_leaf(action_spec, self.synergy_key, synergy_spec, self.parent)
        return (
            action_spec
            if self.synergy_key == self.action_key
            else _without(action_spec, self.action_key)
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        set_leaf(observation_spec, self.executed_key, self._executed_leaf.clone(), self.parent)
        return observation_spec

    def __repr__(self) -> str:
        decoder = self.module
        return (
            f"{type(self).__name__}({type(decoder).__name__} of "
            f"{decoder.synergy_spec.shape[-1]} numbers into {decoder.action_dim} actuators in "
            f"{_interval(decoder.low, decoder.high)}, synergy_key={self.synergy_key!r}, "
            f"action_key={self.action_key!r}, executed_key={self.executed_key!r}, "
            f"decoded_key={self.decoded_key!r})"
        )

    def set_container(self, container: Transform | EnvBase) -> None:
        _refuse_replay_buffer()
        super().set_container(container)
        if self.parent is None:  # a Compose that is not in an env yet
            return
        try:
            self._check_env(self.parent)
        except ValueError:
            self.reset_parent()
            raise

    def train(self, mode: bool = True) -> SynergyAction:
        # A ready-made Compose passed to a buffer is not re-attached, but it is put in eval mode.
        _refuse_replay_buffer()
        return super().train(mode)

    def _check_env(self, env: EnvBase) -> None:
        actions = env.full_action_spec
        if self.action_key not in actions.keys(True, True):
            raise ValueError(
                f"SynergyAction decodes into {self.action_key!r}, but the env's action keys are "
                f"{env.action_keys}; pass one of them as action_key."
            )
        observations = env.full_observation_spec.keys(True, True)
        for key in (self.synergy_key, self.executed_key):
            if key in observations:
                raise ValueError(
                    f"{key!r} is an observation of the env already; give SynergyAction another "
                    "synergy_key or executed_key."
                )
        if isinstance(env.base_env, TransformedEnv) and self.action_key in (
            unravel_key(key) for key in env.base_env.transform.in_keys_inv or ()
        ):
            warnings.warn(
                f"The transforms of an inner environment rewrite {self.action_key!r} out of the "
                f"sight of SynergyAction, so that {self.executed_key!r} is not what the simulator "
                "executes; append SynergyAction to that environment instead.",
                stacklevel=2,
            )
        leaf, decoder = actions[self.action_key], self.module
        if not isinstance(leaf, Bounded | Unbounded):
            raise ValueError(
                f"The env's {self.action_key!r} is {type(leaf).__name__}; a synergy decoder needs "
                "a continuous action."
            )
        if leaf.shape[-1] != decoder.action_dim:
            raise ValueError(
                f"The decoder writes {decoder.action_dim} actuators but the env's "
                f"{self.action_key!r} has {leaf.shape[-1]}; use a decoder fitted on this body."
            )
        if not isinstance(leaf, Bounded):
            return
        low, high = (
            bound.to(leaf.space.low.device, leaf.space.low.dtype).expand(leaf.shape)
            for bound in (decoder.low, decoder.high)
        )
        if not (torch.allclose(low, leaf.space.low) and torch.allclose(high, leaf.space.high)):
            raise ValueError(
                f"The decoder acts in {_interval(low, high)} but the env's {self.action_key!r} is "
                f"bounded by {_interval(leaf.space.low, leaf.space.high)}; use a decoder fitted "
                "with the bounds of this env's action spec."
            )


def _without(spec: Composite, key: NestedKey) -> Composite:
    """``spec`` less one leaf, and less the nodes that it leaves empty."""
    del spec[key]
    while not isinstance(key, str) and spec[key[:-1]].is_empty():
        key = unravel_key(key[:-1])
        del spec[key]
    return spec


def _beside(key: NestedKey, name: str) -> NestedKey:
    return name if isinstance(key, str) else unravel_key((*key[:-1], name))


def _interval(low: Tensor, high: Tensor) -> str:
    """The bounds of all actuators if they share them, else the widest."""
    return f"[{low.min().item():g}, {high.max().item():g}]" + (
        "" if (low == low.min()).all() and (high == high.max()).all() else " at the widest"
    )


def _refuse_replay_buffer() -> None:
    # A buffer tells its transforms nothing: it puts them in a Compose without an env, which is
    # also what every env pipeline is before it is attached. The caller is the only difference.
    frame = sys._getframe(1)
    while frame is not None:
        # ``issubclass``, because TorchRL's ``isinstance`` hook queries attributes of its argument
        # and half-built envs among the callers do not survive that.
        if issubclass(type(frame.f_locals.get("self")), ReplayBuffer):
            raise TypeError(
                "SynergyAction cannot be attached to a replay buffer, because buffers call the "
                "inverse of their transforms on extend and recorded actions would be overwritten; "
                "attach it to the env."
            )
        frame = frame.f_back
