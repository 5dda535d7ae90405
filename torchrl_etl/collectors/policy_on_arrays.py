"""A TensorDict policy evaluated on bare arrays."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import exploration_type

__all__ = ["Arrays", "PolicyOnArrays"]

Arrays = dict[NestedKey, np.ndarray]


class PolicyOnArrays:
    """Calls a policy with arrays by key, and returns what it writes as arrays by key.

    A sequence of plain modules is traced into one graph: the same operations on the same weights
    without Python and TensorDict in between, which the physics of each step drives out of the
    processor's caches. (On batches as small as these ``torch.compile`` and AOTInductor are no
    faster, and take 10 to 35 s to start.) Any other policy is called with a tensordict. Its weights
    may be updated in place at any time; where others replaced them, :meth:`refresh` finds out.

    Examples:
        >>> import numpy as np
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.modules import make_actor
        >>> policy = PolicyOnArrays(make_actor({"observation": 3}, Bounded(-1, 1, shape=(2,))))
        >>> written = policy({"observation": np.zeros((5, 3), np.float32)})
        >>> {key: value.shape for key, value in written.items()}
        {'loc': (5, 2), 'scale': (5, 2), 'action': (5, 2)}
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        self._policy = policy
        self._in_keys, self._out_keys = list(policy.in_keys), list(policy.out_keys)
        leaves = list(_leaves(policy))
        is_plain = all(map(_does_no_more_than_its_keys, leaves))
        self._sequence = _Sequence(leaves, self._in_keys, self._out_keys) if is_plain else None
        self._graph: Callable[..., tuple[Tensor, ...]] | None = None
        self._traced_with: tuple[object, ...] = ()
        self._shape: torch.Size | None = None

    def refresh(self) -> None:
        """Look for other weights, or another exploration type, than the graph was traced with.

        It walks through the whole policy, so a rollout does it once and not at every step.
        """
        if self._identity() != self._traced_with:
            self._graph = None

    @torch.no_grad()
    def __call__(self, inputs: Arrays, device: torch.device | None = None) -> Arrays:
        tensors = [torch.from_numpy(inputs[key]) for key in self._in_keys]
        if device is not None:
            tensors = [tensor.to(device) for tensor in tensors]
        if self._sequence is None:
            named = dict(zip(self._in_keys, tensors, strict=True))
            entries = TensorDict(named, tensors[0].shape[:1])
            written = self._policy(entries)
            outputs = [written[key] for key in self._out_keys]
        else:
            if self._graph is None or tensors[0].shape != self._shape:
                self._graph = self._trace(self._sequence, tensors)
            outputs = self._graph(*tensors)
        arrays = (output.cpu().numpy() for output in outputs)
        return dict(zip(self._out_keys, arrays, strict=True))

    def _trace(
        self, sequence: _Sequence, tensors: list[Tensor]
    ) -> Callable[..., tuple[Tensor, ...]]:
        random = torch.get_rng_state()
        with warnings.catch_warnings():
            # Deprecated in PyTorch 2.13, in favour of what is slower to start (see above); and
            # a distribution's checks of its bounds are constants, as they should be.
            warnings.simplefilter("ignore")
            graph = torch.jit.trace(sequence, tuple(tensors), check_trace=False)
        torch.set_rng_state(random)
        self._traced_with, self._shape = self._identity(), tensors[0].shape
        self._held = self._weights()  # so that no other tensor gets the id of one of these
        return graph

    def _weights(self) -> tuple[Tensor, ...]:
        return (*self._policy.parameters(), *self._policy.buffers())

    def _identity(self) -> tuple[object, ...]:
        # A graph sees new values in the weights it was traced with, but not new tensors.
        return (*map(id, self._weights()), exploration_type())


class _Sequence(nn.Module):
    """The leaves of a policy in order, from tensors to tensors."""

    def __init__(
        self,
        leaves: list[TensorDictModuleBase],
        in_keys: list[NestedKey],
        out_keys: list[NestedKey],
    ) -> None:
        super().__init__()
        self.functions = nn.ModuleList(
            nn.Identity() if isinstance(leaf, ProbabilisticTensorDictModule) else leaf.module
            for leaf in leaves
        )
        # In a tuple, where tracing, which would stumble over tensordict's classes, does not look.
        self.leaves, self.in_keys, self.out_keys = tuple(leaves), in_keys, out_keys

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        entries = dict(zip(self.in_keys, tensors, strict=True))
        for leaf, function in zip(self.leaves, self.functions, strict=True):
            inputs = [entries[key] for key in leaf.in_keys]
            if isinstance(leaf, ProbabilisticTensorDictModule):
                parameters = dict(zip(leaf.dist_keys, inputs, strict=True))
                distribution = leaf.distribution_class(**parameters, **leaf.distribution_kwargs)
                written = leaf._dist_sample(distribution, interaction_type=exploration_type())
            else:
                written = function(*inputs)
            written = (written,) if isinstance(written, Tensor) else written
            entries.update(zip(leaf.out_keys, written, strict=True))
        return tuple(entries[key] for key in self.out_keys)


def _leaves(module: TensorDictModuleBase) -> Iterator[TensorDictModuleBase]:
    if isinstance(module, TensorDictSequential):
        for part in module.module:
            yield from _leaves(part)
    else:
        yield module


def _does_no_more_than_its_keys(leaf: TensorDictModuleBase) -> bool:
    if isinstance(leaf, ProbabilisticTensorDictModule):
        return not leaf.return_log_prob and leaf.num_samples is None
    return type(leaf).forward is TensorDictModule.forward
