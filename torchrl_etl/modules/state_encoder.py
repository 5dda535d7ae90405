"""The state encoder φ, and latent dynamics for the Gaussian divergence of Eq. 2."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_etl.checks import check_integer, check_sizes
from torchrl_etl.modules.calls import as_keys

__all__ = ["GaussianDynamics", "StateEncoder"]


class _Network(nn.Sequential):
    """Accepts any dtype of observation: Gymnasium's MuJoCo tasks use double precision."""

    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(observation.to(self[0].weight.dtype))


class StateEncoder(TensorDictModule):
    """State encoder φ: S → R^k whose distances are trained to be behavioral distances.

    A layer norm follows the first linear layer, so that the units of the observation (radians,
    metres, muscle forces) do not set the scale of the features.

    Args:
        observation_dim (int): size O of the observation.
        embedding_dim (int): size k of the embedding.

    Keyword Args:
        hidden (sequence of int): widths of the hidden layers, at least one.
            Default: ``(256, 256)``.
        in_keys (sequence of NestedKey): the observation. Default: ``("observation",)``.
        out_keys (sequence of NestedKey): the embedding. Default: ``("embedding",)``.

    Keys:
        reads ``observation`` [*, O], of any real dtype; writes ``embedding`` [*, k], unbounded, in
        the dtype of the weights.

    Raises:
        ValueError: if a size or width is not positive, or ``hidden`` is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import StateEncoder
        >>> encoder = StateEncoder(observation_dim=7, embedding_dim=4)
        >>> data = TensorDict({"observation": torch.randn(5, 7)}, [5])
        >>> encoder(data)["embedding"].shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        observation_dim: int,
        embedding_dim: int,
        *,
        hidden: Sequence[int] = (256, 256),
        in_keys: Sequence[NestedKey] = ("observation",),
        out_keys: Sequence[NestedKey] = ("embedding",),
    ) -> None:
        check_integer(1, observation_dim=observation_dim, embedding_dim=embedding_dim)
        check_sizes(hidden=hidden)
        first, *rest = hidden
        network = _Network(
            nn.Linear(observation_dim, first),
            nn.LayerNorm(first),
            nn.ReLU(),
            MLP(first, embedding_dim, num_cells=rest, activation_class=nn.ReLU),
        )
        super().__init__(network, in_keys=as_keys(in_keys), out_keys=as_keys(out_keys))
        self.embedding_dim = embedding_dim


class _GaussianHead(nn.Module):
    def __init__(self, embedding_dim: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.mlp = MLP(
            embedding_dim, 2 * embedding_dim, num_cells=list(hidden), activation_class=nn.ReLU
        )

    def forward(self, embedding: Tensor) -> tuple[Tensor, Tensor]:
        step, raw_scale = self.mlp(embedding).chunk(2, -1)
        # The next embedding is near the present one, so predict only the step.
        return embedding + step, nn.functional.softplus(raw_scale) + 1e-4


class GaussianDynamics(TensorDictModule):
    """Latent model of the policy-induced transition P^π in embedding space (DBC).

    Args:
        embedding_dim (int): size k of the embedding.

    Keyword Args:
        hidden (sequence of int): widths of the hidden layers. Default: ``(128,)``.
        in_keys, out_keys (sequence of NestedKey): see Keys.

    Keys:
        reads ``embedding`` [*, k]; writes ``next_embedding_loc`` and ``next_embedding_scale``
        [*, k], the scale positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules import GaussianDynamics
        >>> dynamics = GaussianDynamics(embedding_dim=4)
        >>> out = dynamics(TensorDict({"embedding": torch.randn(5, 4)}, [5]))
        >>> bool((out["next_embedding_scale"] > 0).all())
        True
    """

    def __init__(
        self,
        embedding_dim: int,
        *,
        hidden: Sequence[int] = (128,),
        in_keys: Sequence[NestedKey] = ("embedding",),
        out_keys: Sequence[NestedKey] = ("next_embedding_loc", "next_embedding_scale"),
    ) -> None:
        check_integer(1, embedding_dim=embedding_dim)
        super().__init__(
            _GaussianHead(embedding_dim, hidden),
            in_keys=as_keys(in_keys),
            out_keys=as_keys(out_keys),
        )
