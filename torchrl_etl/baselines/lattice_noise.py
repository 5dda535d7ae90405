"""Lattice's state-dependent exploration, with noise matrices held for several steps."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_etl.baselines.lattice import LatticeNetwork, StateDependentSpread
from torchrl_etl.checks import check_integer

__all__ = ["LatticeNoise"]


class LatticeNoise(TensorDictModuleBase):
    """Lattice actor whose noise is a function of the state, redrawn every few steps.

    Between two draws the policy is deterministic, so similar states get similar noise. Over draws
    the action in a state has the actor's own distribution (without ``std_reg``), so off-policy
    learners train the actor and need no change.

    The matrices are kept per row of the batch. Every call must have the same simulators in the same
    order, as in a collector. Matrices are not in the state dict, and a copy draws its own. Under an
    exploration type other than random it writes the squashed mean.

    Equation: a = W(x + α P_x x) + b + P_a x, with P_x ~ N(0, S_x²) [H, H], P_a ~ N(0, S_a²) [H, n];
    the action is tanh(a), scaled to the bounds.

    Args:
        actor (ProbabilisticTensorDictSequential): from
            :func:`~torchrl_etl.baselines.lattice.make_lattice_actor` with ``state_dependent=True``.

    Keyword Args:
        freq (int): steps between draws of the matrices. Default: 8.
        init_key (NestedKey): see :class:`torchrl.envs.InitTracker`. Default: ``"is_init"``.

    Keys:
        reads the actor's in-keys and, if present, ``is_init`` [*, 1], bool: rows whose matrices are
        redrawn; writes the actor's sample [*, n], but not mean and covariance, which acting does
        not need.

    Raises:
        TypeError: if the actor is not a state-dependent Lattice actor.
        ValueError: if freq is not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.baselines.lattice import make_lattice_actor
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> policy = LatticeNoise(
        ...     make_lattice_actor({"observation": 3}, spec, hidden=(8,), state_dependent=True)
        ... )
        >>> data = TensorDict({"observation": torch.ones(4, 3)}, [4])
        >>> first, second = policy(data.clone())["action"], policy(data.clone())["action"]
        >>> torch.equal(first, second), torch.equal(first[0], first[1])
        (True, False)
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        *,
        freq: int = 8,
        init_key: NestedKey = "is_init",
    ) -> None:
        check_integer(1, freq=freq)
        network = getattr(actor[0], "module", None)
        if not isinstance(network, LatticeNetwork):
            raise TypeError(
                f"The actor's network is a {type(network).__name__}; pass an actor from "
                "make_lattice_actor(..., state_dependent=True)."
            )
        if not isinstance(network.spread, StateDependentSpread):
            raise TypeError(
                "The actor's noise does not depend on the state; pass an actor from "
                "make_lattice_actor(..., state_dependent=True)."
            )
        super().__init__()
        self.actor, self.freq, self.init_key = actor, freq, init_key
        self.in_keys = [*actor.in_keys, init_key]
        self.out_keys = list(actor.dist_sample_keys)
        self._matrices: tuple[Tensor, Tensor] | None = None
        self._age: Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        network = self.actor[0].module
        features = network.features(*(tensordict.get(key) for key in self.actor[0].in_keys))
        if exploration_type() in (None, ExplorationType.RANDOM):
            is_init = tensordict.get(self.init_key, None)
            latent, direct = self._drawn(features, is_init)
            noisy = features + network.spread.alpha * _times(features, latent)
            value = network.mean(noisy) + _times(features, direct)
        else:
            value = network.mean(features)
        return tensordict.set(self.out_keys[0], self._squashed(value))

    def _squashed(self, value: Tensor) -> Tensor:
        # Uses the distribution's map to the bounds; its covariance has no effect.
        distribution = self.actor[-1].distribution_class(
            value, torch.eye(value.shape[-1]).to(value), **self.actor[-1].distribution_kwargs
        )
        return distribution.deterministic_sample

    @torch.no_grad()
    def _drawn(self, features: Tensor, is_init: Tensor | None) -> tuple[Tensor, Tensor]:
        """P_x [*, H, H] and P_a [*, H, n] of this step."""
        rows = features.shape[:-1]
        scales = self.actor[0].module.spread.scales()
        if self._matrices is None or not _fits(self._matrices[0], features):
            self._matrices = tuple(scale.new_zeros(*rows, *scale.shape) for scale in scales)
            self._age = torch.full(rows, self.freq, device=features.device)
        fresh = self._age >= self.freq
        if is_init is not None:
            fresh = fresh | is_init.squeeze(-1)
        # Draws only what is used: matrices for all rows at every step would cost more than a
        # small simulator's step.
        count = int(fresh.sum())
        if count:
            for matrices, scale in zip(self._matrices, scales, strict=True):
                noise = torch.randn(count, *scale.shape, dtype=scale.dtype, device=scale.device)
                matrices[fresh] = scale * noise
        self._age = torch.where(fresh, 0, self._age) + 1
        return self._matrices

    def __getstate__(self) -> dict[str, Any]:
        # Workers that start with equal matrices would explore alike until the next draw.
        return super().__getstate__() | {"_matrices": None, "_age": None}


def _times(features: Tensor, matrices: Tensor) -> Tensor:
    """Product of each row's vector with its matrix."""
    return (features.unsqueeze(-2) @ matrices).squeeze(-2)


def _fits(matrices: Tensor, features: Tensor) -> bool:
    return (
        matrices.shape[:-2] == features.shape[:-1]
        and matrices.device == features.device
        and matrices.dtype == features.dtype
    )
