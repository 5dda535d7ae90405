"""Compile an update into one graph, with a fallback to eager execution."""

from __future__ import annotations

import ctypes
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import wraps
from typing import Any
from unittest.mock import patch

import torch
from tensordict.nn import CudaGraphModule
from tensordict.nn.functional_modules import _exclude_td_from_pytree
from torch import Tensor, _inductor
from torch._functorch import compile_utils
from torch._guards import TracingContext, tracing
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files
from torch._subclasses import FakeTensorMode
from torch.fx import Graph
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import ShapeEnv
from torch.utils._pytree import TreeSpec, tree_flatten, tree_unflatten

from torchrl_etl.learners.products import faster_products

__all__ = ["compiled", "cuda_graph"]

_ELSE = "compile=false skips compilation"


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Trace a function of tensors or tensordicts into one graph at its first call, and compile it.

    With :func:`torch.autograd.grad` inside the graph, nothing is saved between separate forward and
    backward graphs. On CPUs without AVX-512, saving ReLU masks as booleans would cost as much as a
    third of the matrix products.

    Tracing runs the function (:func:`~torch.fx.experimental.proxy_tensor.make_fx`), so TensorDict's
    Python overhead is paid once. Inputs of other shapes trigger a recompilation, as does another
    number of PyTorch's threads, for which kernels are generated. Any other tensors that the
    function reads must keep their identity, though their values may change, and no branch may
    depend on values. Random numbers come from PyTorch's generator and match eager execution.

    If compilation fails (no compiler, a read-only cache, an unsupported operation), a warning gives
    the reason and the function runs uncompiled from this call on. The function must therefore have
    no side effects.

    Examples:
        >>> import torch
        >>> x = torch.ones(3, requires_grad=True)
        >>> slope = compiled(lambda x: torch.autograd.grad(x.square().sum(), x)[0])
        >>> slope(x)  # doctest: +SKIP
        tensor([2., 2., 2.])
    """
    graphs: list[tuple[Any, Callable[..., Any]]] = []
    failed = False

    @wraps(function)
    def call(*args: Any) -> Any:
        nonlocal failed
        if failed:
            return function(*args)
        leaves, spec = tree_flatten(args)
        layouts = [(leaf.shape, leaf.stride(), leaf.dtype, leaf.device) for leaf in leaves]
        kind = torch.get_num_threads(), spec, layouts
        try:
            graph = next((graph for known, graph in graphs if known == kind), None)
            if graph is None:
                graph = _graph(function, spec, leaves)
                graphs.append((kind, graph))
            return graph(leaves)
        except Exception as error:
            failed = True
            warnings.warn(
                f"Updates run uncompiled, which takes about twice as long: {_reason(error)}.",
                RuntimeWarning,
                stacklevel=2,
            )
        return function(*args)

    return call


def _graph(
    function: Callable[..., Any], spec: TreeSpec, inputs: list[Tensor]
) -> Callable[[list[Tensor]], Any]:
    """Compile the function for inputs like these; returns a function of their flat tensors."""
    returned: TreeSpec | None = None

    def flat(*leaves: Tensor) -> list[Any]:
        nonlocal returned
        out, returned = tree_flatten(function(*tree_unflatten(list(leaves), spec)))
        return out

    # All sizes are static, but inductor (torch 2.13) caches nothing without a shape environment.
    fake = FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True)
    stand_ins = [fake.from_tensor(each, static_shapes=True) for each in inputs]
    with torch.random.fork_rng():  # compilation draws random numbers
        # As under torch.compile, skip checks that look at values.
        with torch.compiler._compile_session_context():
            trace = make_fx(
                flat, decomposition_table=faster_products(), _allow_non_fake_inputs=True
            )
            traced = trace(*stand_ins)
        # Launch kernels from C++ rather than Python: this saves 3 to 5 % of an update.
        options = _options() | {"cpp_wrapper": all(each.device.type == "cpu" for each in inputs)}
        options["post_grad_custom_pre_pass"] = _ComputeOnce()
        with torch.no_grad(), tracing(TracingContext(fake)), _inductor.config.patch(options):
            run = _inductor.compile(traced, stand_ins)

    def call(leaves: list[Tensor]) -> Any:
        with torch.no_grad():
            return tree_unflatten(run(*leaves), returned)

    return call


class _ComputeOnce(CustomGraphPass):
    """Common subexpression elimination: two losses evaluate the same critic on the same states.

    Inductor (torch 2.13) applies it only to graphs that autograd splits in two. Random operations
    are never merged; PyTorch's own list of them lacks ``randn_like``.
    """

    def __call__(self, graph: Graph) -> None:
        draws = [
            compile_utils.get_aten_target(node)
            for node in graph.nodes
            if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ())
        ]
        with patch.object(compile_utils, "rand_ops", [*compile_utils.rand_ops, *draws]):
            graph.owning_module.graph = compile_utils.fx_graph_cse(graph)

    def uuid(self) -> bytes:
        return get_hash_for_files((__file__,))


def cuda_graph(function: Callable[..., Any]) -> Callable[..., Any]:
    """Capture a function of a tensordict as a CUDA graph and replay it in one launch."""
    # tensordict 0.14.3 would otherwise unregister TensorDict from PyTree permanently.
    with _exclude_td_from_pytree():
        return CudaGraphModule(function, in_keys=[], out_keys=[], warmup=5)


def _options() -> dict[str, Any]:
    """Inductor options for eager random numbers, and for paths that contain spaces.

    Inductor (torch 2.13) passes the folders of PyTorch's libraries, its cache and its precompiled
    headers to a shell without quotes.
    """
    from torch._inductor.runtime.cache_dir_utils import cache_dir, default_cache_dir
    from torch.utils.cpp_extension import TORCH_LIB_PATH

    options: dict[str, Any] = {"fallback_random": True}
    if _is_split(cache_dir()):
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = f"/tmp/torchinductor_{os.getuid()}"
    if _is_split(default_cache_dir()):  # holds the precompiled headers, wherever the cache is
        options["cpp_cache_precompile_headers"] = False
    if _is_split(TORCH_LIB_PATH):
        # Kernels then resolve symbols from the process, where the load below makes them global.
        options["aot_inductor.link_libtorch"] = False
        library = os.path.join(TORCH_LIB_PATH, "libtorch_cpu.so")
        with suppress(OSError):  # it has another name outside Linux
            ctypes.CDLL(library, mode=os.RTLD_GLOBAL | os.RTLD_NOLOAD)
    return options


def _is_split(path: str) -> bool:
    return os.name == "posix" and any(character in path for character in " \t\n'\"\\")


def _reason(error: BaseException) -> str:
    """Why a compilation failed and how to fix it, as a clause for the warning."""
    from torch._inductor.exc import CppCompileError, InvalidCxxCompiler, TritonMissing

    for cause in _causes(error):
        match cause:
            case InvalidCxxCompiler():
                names = torch._inductor.config.cpp.cxx
                name = names if isinstance(names, str) else names[-1]
                return (
                    f"there is no C++ compiler ({name} does not run); install one "
                    "(apt install g++), or set the variable CXX to one"
                )
            case TritonMissing():
                return "Triton, which compiles for GPUs, is not installed; pip install triton"
            case CppCompileError() if "Python.h" in cause.output:
                return "the Python headers are missing; install them (apt install python3-dev)"
            case CppCompileError():
                return f"the C++ compiler failed ({_first_line(cause.output)}); {_ELSE}"
            case OSError() if cause.filename:
                return (
                    f"{cause.filename}: {cause.strerror}; set the variable TORCHINDUCTOR_CACHE_DIR "
                    "to a writable folder with free space"
                )
    told = getattr(error, "inner_exception", None) or error
    return f"{type(told).__name__}: {_first_line(str(told))}; {_ELSE}"


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and its causes, innermost first."""
    if error is not None:
        yield from _causes(getattr(error, "inner_exception", None) or error.__cause__)
        yield error


def _first_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    telling = [line for line in lines if "error" in line or "cannot" in line]
    return (telling or lines or ["no message"])[0].rstrip(".")
