"""A latent space as the action space: a module decodes the policy's actions for the env."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import ModuleTransform, Transform, TransformedEnv

from torchrl_etl.objectives.checks import read
from torchrl_etl.transforms.keys import (
    check_network,
    group_shape,
    private_key,
    set_leaf,
    set_where_reset,
)

__all__ = ["LatentAction"]


class LatentAction(ModuleTransform):
    """Lets a policy act in the latent space of a module that decodes actions.

    The action spec of the transformed env is ``latent_spec``; at each step the inverse pass runs
    the module on the latent action and the env executes its output, without gradients.

    In a collector's batches root ``latent`` and root ``action`` are a matching pair, as if the
    policy ended in the module, also with n-step returns. ``("next", "executed_action")`` is what
    the simulator executed, after clips and scalings between it and this transform. Root
    ``executed_action`` is from the previous step.

    ``env.step``, ``env.rollout`` and the workers of ``SerialEnv`` and ``ParallelEnv`` cannot write
    to the root, so ``action`` is missing. There the pair is root ``latent`` and
    ``("next", "executed_action")``. Before n-step returns, copy the latter to the root with
    ``RenameTransform([("next", "executed_action")], ["action"], create_copy=True)``. A replay
    buffer that several collectors share, or whose first data is a rollout, has no root ``action``
    either; without n-step returns, append the same transform to it.

    The module is held by reference: changing its weights in place changes the next step. It is a
    submodule, so it is in ``state_dict()``, and attaching moves it to the env's device and to eval
    mode, as TorchRL does with every module. Pass a copy if a learner trains the original. In
    another process the module is the copy made when the worker started.

    Outside an environment it raises: a replay buffer would call the inverse on ``extend`` and
    overwrite recorded actions. To decode elsewhere, call :meth:`decode`.

    Args:
        module (TensorDictModuleBase): reads one latent action and writes one action within the
            env's bounds.
        latent_spec (TensorSpec): unbatched spec of one latent action, the policy's output.

    Keyword Args:
        latent_key (NestedKey): key that the policy writes. Use ``"action"`` for policies that can
            write no other; the recorded ``"action"`` is then the latent one. Default: ``"latent"``.
        executed_key (NestedKey): where the executed action is recorded.
            Default: ``"executed_action"``.
        action_key (NestedKey, optional): the base env's action. Default: the module's out-key.
        decoded_key (NestedKey, optional): key of the decoded action in a collector's batch.
            Default: ``action_key``, or ``"decoded_action"`` beside it if that is the latent's key.

    Keys:
        reads ``latent`` [*, d] of ``latent_spec``; writes ``("next", "executed_action")`` of the
        base env's action spec, ``executed_action`` at reset (zeros clamped to the bounds) and,
        under a collector, ``action`` [*, n]. For a group of agents, give keys inside the group.

    Raises:
        TypeError: if the module lacks keys.
        ValueError: if keys collide; when attached to an env, if the env has no such action key or
            the module's actions have another shape.
        RuntimeError: if called forward or inverted outside an env, as by a replay buffer.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_etl.transforms import LatentAction
        >>> mean = TensorDictModule(lambda z: 2 * z.mean(-1, True), ["latent"], ["action"])
        >>> latent_action = LatentAction(mean, Bounded(-1, 1, shape=(3,)))
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), latent_action)
        >>> env.action_keys, env.full_action_spec["latent"].shape
        (['latent'], torch.Size([3]))
        >>> rollout = env.rollout(5)
        >>> bool((rollout["next", "executed_action"] == 2 * rollout["latent"].mean(-1, True)).all())
        True
    """

    def __init__(
        self,
        module: TensorDictModuleBase,
        latent_spec: TensorSpec,
        *,
        latent_key: NestedKey = "latent",
        executed_key: NestedKey = "executed_action",
        action_key: NestedKey | None = None,
        decoded_key: NestedKey | None = None,
    ) -> None:
        check_network("module", module, ["one latent action"], "one action")
        super().__init__(module=module, inverse=True, no_grad=True)
        self.latent_spec, self.latent_key = latent_spec, unravel_key(latent_key)
        self.executed_key = unravel_key(executed_key)
        self.action_key = unravel_key(module.out_keys[0] if action_key is None else action_key)
        if decoded_key is None:
            decoded_key = self.action_key
            if self.action_key == self.latent_key:
                path = (decoded_key,) if isinstance(decoded_key, str) else decoded_key
                decoded_key = (*path[:-1], "decoded_action")
        self.decoded_key = unravel_key(decoded_key)
        if self.executed_key in (self.latent_key, self.action_key):
            raise ValueError(
                f"executed_key is {self.executed_key!r}, which already names the latent or the "
                "action; choose a key of its own, such as 'executed_action'."
            )
        if self.decoded_key in (self.latent_key, self.executed_key):
            raise ValueError(
                f"decoded_key is {self.decoded_key!r}, which already names the latent or the "
                "executed action; choose a key of its own, such as 'decoded_action'."
            )

    def _in_keys_inv(self) -> list[NestedKey]:
        return [self.action_key]

    def _out_keys_inv(self) -> list[NestedKey]:
        return [self.latent_key]

    @property
    def _decoded_copy(self) -> NestedKey:
        # Read by ``_step`` only. It cannot be the action key, which inner transforms such as an
        # action scaling rewrite on the way to the env.
        return private_key(self.executed_key, self.decoded_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:
            raise self._outside_an_env()
        if self.missing_tolerance and tensordict.get(self.latent_key, None) is None:
            return tensordict
        cure = "let the policy write it"
        action = self.decode(read(type(self).__name__, tensordict, self.latent_key, cure=cure))
        tensordict.set(self.action_key, action)
        return tensordict.set(self._decoded_copy, action)

    @torch.no_grad()
    def decode(self, latent: Tensor) -> Tensor:
        """Actions [*, n] for latent actions [*, d], in the env's dtype."""
        batch_size = latent.shape[: latent.ndim - self.latent_spec.ndim]
        if latent.shape != (*batch_size, *self.latent_spec.shape):
            raise ValueError(
                f"{self.latent_key!r} has shape {list(latent.shape)}; it must end with "
                f"{list(self.latent_spec.shape)}."
            )
        latent = latent.to(self.latent_spec.dtype)
        entry = self.module(TensorDict({self.module.in_keys[0]: latent}, batch_size))
        action = entry.get(self.module.out_keys[0])
        return action if self.parent is None else action.to(self._action_leaf.dtype)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise self._outside_an_env()

    def _outside_an_env(self) -> RuntimeError:
        return RuntimeError(
            f"{type(self).__name__} acts in the inverse pass of an env only; attach it to the env. "
            "In a replay buffer it would overwrite recorded actions on extend. To decode "
            "elsewhere, call its decode(latent) or the module itself."
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # ``tensordict`` is the copy that the inverse passes of all transforms worked on.
        decoded = tensordict.get(self._decoded_copy)
        if isinstance(self.collector, Collector):
            # The copy's root is lost, as is the step's where a collector moves data between
            # devices. The carrier is what the collector stores.
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
        rest = self.rest(tensordict_reset.batch_size)
        return set_where_reset(self.parent, tensordict, tensordict_reset, self.executed_key, rest)

    # VectorCollector calls these three, see its ArrayTransform.

    def array_action(self, now: dict[NestedKey, Any]) -> np.ndarray:
        latent = torch.from_numpy(now[self.latent_key])
        now[self.decoded_key] = self.decode(latent).numpy()
        return now[self.decoded_key]

    def array_step(self, now: dict[NestedKey, Any], after: dict[NestedKey, Any]) -> None:
        after[self.executed_key] = now[self.decoded_key]

    def array_reset(
        self, now: dict[NestedKey, Any], fresh: dict[NestedKey, Any], done: np.ndarray
    ) -> None:
        executed = now[self.executed_key].copy()
        executed[done] = self.rest(torch.Size(done.shape))[done].numpy()
        fresh[self.executed_key] = executed

    def rest(self, batch_size: torch.Size) -> Tensor:
        """Executed action before the first step, by convention: zeros clamped to the bounds."""
        leaf = self._executed_leaf
        rest = leaf.zero()
        if isinstance(leaf, Bounded):
            rest = rest.clamp(leaf.space.low, leaf.space.high)
        # Without a batch lock, the batch size comes from the data.
        return rest.expand((*batch_size, *rest.shape[self.parent.ndim :])).clone()

    @property
    def _action_leaf(self) -> TensorSpec:
        return self.parent.full_action_spec[self.action_key]

    def _batch_size(self, leaf: TensorSpec) -> torch.Size:
        scalar = leaf.ndim == len(group_shape(self.parent, self.action_key))
        return leaf.shape if scalar else leaf.shape[:-1]

    @property
    def _base_key(self) -> NestedKey | None:
        """The base env's key of the action, or None if it is not known."""
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
        batch_size = self._batch_size(leaf)
        latent_spec = self.latent_spec.expand((*batch_size, *self.latent_spec.shape))
        latent_spec = latent_spec.to(leaf.device or latent_spec.device)
        # Set before deleting: a group that is empty in between would lose its batch size.
        set_leaf(action_spec, self.latent_key, latent_spec, self.parent)
        return (
            action_spec
            if self.latent_key == self.action_key
            else _without(action_spec, self.action_key)
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        set_leaf(observation_spec, self.executed_key, self._executed_leaf.clone(), self.parent)
        return observation_spec

    def __repr__(self) -> str:
        return f"{type(self).__name__}({type(self.module).__name__}, {self._keys()})"

    def _keys(self) -> str:
        names = ("latent_key", "action_key", "executed_key", "decoded_key")
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in names)

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        if self.parent is None:  # a Compose that is not in an env yet
            return
        try:
            self._check_env(self.parent)
        except ValueError:
            self.reset_parent()
            raise

    def _check_env(self, env: EnvBase) -> None:
        name, actions = type(self).__name__, env.full_action_spec
        if self.action_key not in actions.keys(True, True):
            raise ValueError(
                f"{name} decodes into {self.action_key!r}, but the env's action keys are "
                f"{env.action_keys}; pass one of them as action_key."
            )
        observations = env.full_observation_spec.keys(True, True)
        for key in (self.latent_key, self.executed_key):
            if key in observations:
                raise ValueError(
                    f"{key!r} is an observation of the env already; give {name} another key for it."
                )
        if isinstance(env.base_env, TransformedEnv) and self.action_key in (
            unravel_key(key) for key in env.base_env.transform.in_keys_inv or ()
        ):
            warnings.warn(
                f"The transforms of an inner environment rewrite {self.action_key!r} after {name}, "
                f"so {self.executed_key!r} is not what the simulator executes; append {name} to "
                "that environment instead.",
                stacklevel=2,
            )
        self._check_action(actions[self.action_key])

    def _check_action(self, leaf: TensorSpec) -> None:
        weights = [*self.module.parameters(), *self.module.buffers()]
        latent = self.latent_spec.zero()
        shape = self.decode(latent.to(weights[0].device) if weights else latent).shape
        own = leaf.shape[len(self._batch_size(leaf)) :]
        if shape != own:
            raise ValueError(
                f"The module makes actions of shape {list(shape)} but the env's "
                f"{self.action_key!r} has {list(own)}; use a module made for this env."
            )


def _without(spec: Composite, key: NestedKey) -> Composite:
    """``spec`` without one leaf, and without nodes that are empty then."""
    del spec[key]
    while not isinstance(key, str) and spec[key[:-1]].is_empty():
        key = unravel_key(key[:-1])
        del spec[key]
    return spec
