"""A TensorDict policy evaluated on NumPy arrays."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from operator import is_not

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import exploration_type

from torchrl_etl.modules.calls import calls_module_only

__all__ = ["Arrays", "PolicyOnArrays"]

Arrays = dict[NestedKey, np.ndarray]

# Modules of these packages are traceable: _constants holds all that changes what they compute.
_OURS = "torchrl_etl."
_THEIRS = ("tensordict.nn.", "torchrl.modules.models.models", "torchrl.modules.tensordict_module.")
_KNOWN = (_OURS, "torch.nn.", *_THEIRS)
_KNOWN_DISTRIBUTIONS = (_OURS, "torch.distributions.", "torchrl.modules.distributions.")


class PolicyOnArrays:
    """Calls a policy with a dict of arrays and returns the entries that it writes.

    A policy of plain modules of ``torch.nn``, TensorDict, TorchRL and this package, without hooks
    or log-probabilities, is traced into one graph. The graph runs the same operations on the same
    weights without the overhead of Python and TensorDict, whose code the physics of each step
    evicts from the CPU caches. (On such small batches ``torch.compile`` and AOTInductor are no
    faster, and take 10 to 35 s to start.)

    In modules of other packages, a graph would freeze branches, counters and other Python state. A
    policy with such a module is called with a tensordict of all arrays instead. All entries are
    then returned, so that a stateful policy can read them in the next call.

    Weights may be updated in place at any time; :meth:`refresh` detects other changes.

    Examples:
        >>> import numpy as np
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.modules import make_actor
        >>> policy = PolicyOnArrays(make_actor({"observation": 3}, Bounded(-1, 1, shape=(2,))))
        >>> written = policy({"observation": np.zeros((5, 3), np.float32)})
        >>> {key: value.shape for key, value in written.items()}
        {'loc': (5, 2), 'scale': (5, 2), 'action': (5, 2)}
    """

    foreign: list[type]
    """Classes from outside this package that prevent tracing."""

    def __init__(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> None:
        self._policy = policy
        self._constants: list[object] = []
        self._shape: torch.Size | None = None
        self.refresh()

    def refresh(self) -> None:
        """Discard the graph if the policy has changed in more than the values of its tensors.

        This walks through the whole policy: call it once per rollout, not at every step.
        """
        found = list(_constants(self._policy))
        if len(found) != len(self._constants) or any(map(is_not, found, self._constants)):
            self._constants = found  # a reference, so that no new object reuses an id
            opaque = {type(module) for module in _opaque(self._policy)}
            self.foreign = [kind for kind in opaque if not kind.__module__.startswith(_OURS)]
            self._sequence = None if opaque else _Sequence(self._policy)
            self._graph: Callable[..., tuple[Tensor, ...]] | None = None

    @torch.no_grad()
    def __call__(self, inputs: Arrays, device: torch.device | None = None) -> Arrays:
        # A foreign policy may read entries that are not in its in_keys.
        keys = inputs if self.foreign else self._policy.in_keys
        tensors = [torch.from_numpy(inputs[key]) for key in keys]
        if device is not None:
            tensors = [tensor.to(device) for tensor in tensors]
        if self._sequence is None:
            root = TensorDict(dict(zip(keys, tensors, strict=True)), len(tensors[0]), device=device)
            written = root.update(self._policy(root)).items(True, True)
        else:
            if self._graph is None or tensors[0].shape != self._shape:
                self._graph = self._trace(self._sequence, tensors)
            written = zip(self._sequence.out_keys, self._graph(*tensors), strict=True)
        return {key: tensor.numpy(force=True) for key, tensor in written}

    def _trace(
        self, sequence: _Sequence, tensors: list[Tensor]
    ) -> Callable[..., tuple[Tensor, ...]]:
        # Tracing runs the policy once; undo its effect on random state and buffers.
        random, buffers = torch.get_rng_state(), list(self._policy.buffers())
        before = [buffer.clone() for buffer in buffers]
        with warnings.catch_warnings():
            # torch.jit.trace is deprecated in PyTorch 2.13 for alternatives that start slower (see
            # above). It also warns that a distribution's checks become constants, as intended.
            warnings.simplefilter("ignore")
            graph = torch.jit.trace(sequence, tuple(tensors), check_trace=False)
        torch.set_rng_state(random)
        for buffer, value in zip(buffers, before, strict=True):
            buffer.copy_(value)
        self._shape = tensors[0].shape
        return graph


class _Sequence(nn.Module):
    """The leaves of a policy in order, from tensors to tensors."""

    def __init__(self, policy: TensorDictModuleBase) -> None:
        super().__init__()
        # A tuple hides them from tracing, which fails on tensordict's classes.
        self.leaves = tuple(_leaves(policy))
        self.functions = nn.ModuleList(
            nn.Identity() if isinstance(leaf, ProbabilisticTensorDictModule) else leaf.module
            for leaf in self.leaves
        )
        self.in_keys = list(policy.in_keys)
        self.out_keys = [key for key in policy.out_keys if key != "_"]  # "_": discarded output

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


def _constants(policy: object) -> Iterator[object]:
    """Everything that a trace freezes. Only the values of tensors may change after it."""
    yield exploration_type()
    for module in _modules(policy):
        yield module
        for value in vars(module).values():
            yield from value.values() if isinstance(value, dict) else (value,)


def _opaque(policy: object) -> Iterator[object]:
    """Modules that a trace might not capture fully."""
    if not isinstance(policy, nn.Module):
        yield policy
    for module in _modules(policy):
        is_hooked = bool(module._forward_hooks or module._forward_pre_hooks)
        if is_hooked or not type(module).__module__.startswith(_KNOWN) or not _is_plain(module):
            yield module


def _modules(policy: object) -> Iterable[nn.Module]:
    return policy.modules() if isinstance(policy, nn.Module) else ()


def _is_plain(module: nn.Module) -> bool:
    """Whether the module has no effect beyond reading and writing its keys."""
    if isinstance(module, TensorDictSequential):
        return not module.partial_tolerant
    if isinstance(module, ProbabilisticTensorDictModule):
        origin = getattr(module.distribution_class, "__module__", "")
        return (
            origin.startswith(_KNOWN_DISTRIBUTIONS)
            and not module.return_log_prob
            and module.num_samples is None
            and module._generator is None
            and module._generator_key is None
        )
    if isinstance(module, TensorDictModuleBase):
        return calls_module_only(module)
    return getattr(module, "momentum", 0) is not None  # batch norm without momentum keeps a count
