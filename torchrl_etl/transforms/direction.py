"""The direction z_sp that an episode of the explore stage follows through embedding space."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_etl.checks import check_choice, check_integer
from torchrl_etl.transforms.keys import SoleWriter, group_shape, set_leaf, set_where_reset

__all__ = ["DirectionPrimer"]


class DirectionPrimer(SoleWriter, TensorDictPrimer):
    """Draws a unit vector at the start of each episode and keeps it until the end.

    Works on single, serial, parallel and vectorized envs; the batch size comes from the env. At a
    partial reset only the envs that reset get a new direction. Draws come from torch's global
    generator. TorchRL does not seed it in worker processes until ``set_seed`` is called on the
    batched env or collector: without that call workers can draw identical directions.

    In a group of agents (``out_key=("agents", "direction")``) each agent gets its own direction.

    Called on a tensordict outside an env (in an ``nn.Sequential``, on a replay buffer's sample
    path) it draws one direction per element, unless the tensordict already has directions.

    Equation: z_sp of Eq. 1.

    Deviates: the paper says both "d unit vectors" (a finite set) and "sample unit latent vector"
    (Algorithm 1). The default is the sphere; ``kind="orthonormal"`` is the finite set.

    Args:
        embedding_dim (int): size k of the direction, which is the size of the state embedding.

    Keyword Args:
        kind (str): ``"sphere"`` draws uniformly on the unit sphere (±1 where k is 1),
            ``"orthonormal"`` picks one of the first ``num_directions`` unit vectors of the
            standard basis. Default: ``"sphere"``.
        num_directions (int, optional): size of the orthonormal set, at most k. Default: k.
        out_key (NestedKey): Default: ``"direction"``.

    Keys:
        writes ``direction`` [*, k], unit norm, entries in [-1, 1], at reset; it is carried to
        ``("next", "direction")`` at every step.

    Raises:
        ValueError: if a size is not positive, the kind is unknown, or ``num_directions`` does not
            fit the kind or exceeds k; when attached, if something else also writes ``out_key``.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv, SerialEnv, TransformedEnv
        >>> from torchrl_etl.transforms import DirectionPrimer
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), DirectionPrimer(4))
        >>> direction = env.rollout(3)["direction"]
        >>> direction.shape, bool((direction == direction[0]).all())
        (torch.Size([3, 4]), True)
        >>> primer = DirectionPrimer(4, kind="orthonormal", num_directions=2)
        >>> env = TransformedEnv(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), primer)
        >>> env.reset()["direction"].sum(-1)
        tensor([1., 1.])
    """

    def __init__(
        self,
        embedding_dim: int,
        *,
        kind: Literal["sphere", "orthonormal"] = "sphere",
        num_directions: int | None = None,
        out_key: NestedKey = "direction",
    ) -> None:
        check_integer(1, embedding_dim=embedding_dim)
        check_choice("kind", kind, ("sphere", "orthonormal"))
        if kind == "sphere" and num_directions is not None:
            raise ValueError(
                f"num_directions is {num_directions}, but a sphere has no finite set of "
                "directions; pass kind='orthonormal' or drop num_directions."
            )
        num_directions = embedding_dim if num_directions is None else num_directions
        check_integer(1, num_directions=num_directions)
        if num_directions > embedding_dim:
            raise ValueError(
                f"num_directions is {num_directions}, but only {embedding_dim} orthonormal "
                f"directions fit into {embedding_dim} dimensions; lower it or raise embedding_dim."
            )
        out_key = unravel_key(out_key)
        super().__init__(
            primers=Composite({out_key: Bounded(-1.0, 1.0, shape=(embedding_dim,))}),
            expand_specs=True,
        )
        self.out_keys = [out_key]
        self.embedding_dim, self.kind, self.num_directions = embedding_dim, kind, num_directions

    def draw(self, batch_size: torch.Size, device: torch.device | None = None) -> Tensor:
        """Unit vectors [*batch_size, k]."""
        if self.kind == "orthonormal":
            index = torch.randint(self.num_directions, batch_size, device=device)
            return torch.nn.functional.one_hot(index, self.embedding_dim).to(self._leaf.dtype)
        gauss = torch.randn(*batch_size, self.embedding_dim, device=device, dtype=self._leaf.dtype)
        # Rounding can leave a lone large component one bit above 1, outside the spec.
        return torch.nn.functional.normalize(gauss, dim=-1).clamp(-1.0, 1.0)

    @property
    def _leaf(self) -> Bounded:
        return self.primers[self.out_keys[0]]

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        # The base class expands ``self.primers`` in place, which ties the transform to its first
        # env. Here they stay unbatched, so a clone serves an env of another batch size.
        (key,) = self.out_keys
        leaf = self._leaf.expand(*group_shape(self.parent, key), self.embedding_dim)
        if observation_spec.device is not None:
            leaf = leaf.to(observation_spec.device)
        set_leaf(observation_spec, key, leaf, self.parent)
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.get(self.out_keys[0], None) is None:
            self._reset_func(tensordict, tensordict)
        return tensordict

    def _reset_func(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Draws for every env: at a partial reset TorchRL keeps only those of the envs that reset.
        return tensordict_reset.set(self.out_keys[0], self._drawn_for(tensordict_reset))

    def _drawn_for(self, tensordict_reset: TensorDictBase) -> Tensor:
        (key,) = self.out_keys
        shape = tensordict_reset.batch_size
        if self.parent is not None:  # without a batch lock the size comes from the data
            shape = shape + group_shape(self.parent, key)[self.parent.ndim :]
        elif not isinstance(key, str) and key[:-1] in tensordict_reset.keys(True):
            shape = tensordict_reset.get(key[:-1]).batch_size
        return self.draw(shape, tensordict_reset.device)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        fresh = self._drawn_for(tensordict_reset)
        return set_where_reset(self.parent, tensordict, tensordict_reset, self.out_keys[0], fresh)

    def array_step(self, now: dict[NestedKey, Any], after: dict[NestedKey, Any]) -> None:
        """See :class:`~torchrl_etl.collectors.VectorCollector`."""
        (key,) = self.out_keys
        after[key] = now[key]

    def array_reset(
        self, now: dict[NestedKey, Any], fresh: dict[NestedKey, Any], done: np.ndarray
    ) -> None:
        """See :class:`~torchrl_etl.collectors.VectorCollector`."""
        (key,) = self.out_keys
        drawn = self.draw(torch.Size(done.shape)).numpy()  # for all rows, as in a plain reset
        fresh[key] = np.where(done[:, None], drawn, now[key])

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(embedding_dim={self.embedding_dim}, kind={self.kind!r}, "
            f"num_directions={self.num_directions}, out_key={self.out_keys[0]!r})"
        )
