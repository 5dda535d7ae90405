"""The synergy decoder as an action-mapping transform: the policy acts in d dimensions, not n."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded

from torchrl_etl.transforms.latent_action import LatentAction

__all__ = ["SynergyAction"]


class SynergyAction(LatentAction):
    """Lets a policy act through a synergy decoder.

    A :class:`~torchrl_etl.transforms.LatentAction` whose latent space is the decoder's
    ``synergy_spec``. It refuses an env with other actuators or bounds than the decoder's.

    Equation: a = Dec(z^a) of section 4.2.

    Args:
        decoder (TensorDictModuleBase): has one in-key, one out-key, and ``synergy_spec``
            (unbatched), ``action_dim``, ``low`` and ``high`` of
            :class:`~torchrl_etl.modules.SynergyDecoder`.

    Keyword Args:
        synergy_key (NestedKey): key that the policy writes. Use ``"action"`` for policies that can
            write no other; the recorded ``"action"`` is then the synergy. Default: ``"synergy"``.
        **keys: ``executed_key``, ``action_key`` and ``decoded_key`` of
            :class:`~torchrl_etl.transforms.LatentAction`.

    Keys:
        as in :class:`~torchrl_etl.transforms.LatentAction`, with ``synergy`` [*, d] in [-1, 1] and
        ``action`` [*, n] in [low, high].

    Raises:
        TypeError: if the decoder lacks keys or attributes.
        ValueError: if keys collide; when attached to an env, if the env has no such action key or
            its number of actuators or bounds are not the decoder's.
        RuntimeError: if called forward or inverted outside an env, as by a replay buffer.

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
        **keys: NestedKey | None,
    ) -> None:
        needed = ("in_keys", "out_keys", "synergy_spec", "action_dim", "low", "high")
        missing = [name for name in needed if not hasattr(decoder, name)]
        if missing:
            raise TypeError(
                f"The decoder is a {type(decoder).__name__} without {', '.join(missing)}; pass a "
                "torchrl_etl.modules.SynergyDecoder or a TensorDictModule that has them."
            )
        super().__init__(decoder, decoder.synergy_spec, latent_key=synergy_key, **keys)

    @property
    def synergy_key(self) -> NestedKey:
        """Key that the policy writes."""
        return self.latent_key

    def decode(self, latent: Tensor) -> Tensor:
        action = super().decode(latent)
        if self.parent is None or not isinstance(leaf := self._action_leaf, Bounded):
            return action
        # Bounds are rounded to single precision too; every row has the decoder's.
        row = (0,) * (leaf.ndim - 1)
        return action.clamp(leaf.space.low[row], leaf.space.high[row])

    def __repr__(self) -> str:
        decoder = self.module
        return (
            f"{type(self).__name__}({type(decoder).__name__} of "
            f"{decoder.synergy_spec.shape[-1]} numbers into {decoder.action_dim} actuators in "
            f"{_interval(decoder.low, decoder.high)}, {self._keys()})"
        )

    def _check_action(self, leaf: TensorSpec) -> None:
        decoder = self.module
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


def _interval(low: Tensor, high: Tensor) -> str:
    """Text of the actuators' bounds if all share them, else of the widest."""
    return f"[{low.min().item():g}, {high.max().item():g}]" + (
        "" if (low == low.min()).all() and (high == high.max()).all() else " at the widest"
    )
