"""An update as one compiled graph, or as it is where nothing can be compiled."""

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

_ELSE = "compile=false leaves out the attempt"


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Trace a function of tensors or tensordicts into one graph at its first call, and compile it.

    With :func:`torch.autograd.grad` inside the graph nothing has to be kept between a forward and
    a backward half: on CPUs without AVX-512 the masks of rectifiers, kept as booleans, would cost
    as much as a third of the products.

    It is traced by running it (:func:`~torch.fx.experimental.proxy_tensor.make_fx`), so that what
    TensorDict does in Python costs no more than once, and is compiled anew for inputs of other
    sizes. Whatever else it reads must stay the same tensors, whose values may change, and no branch
    may depend on values. It draws from PyTorch's generator as it would uncompiled, so the numbers
    are the same.

    Whatever stops a compilation (no compiler, a cache that cannot be written, an operation that
    the compiler does not know) costs a warning that says why; the function then runs uncompiled,
    this call included. It must change nothing but what it returns.

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
        kind = spec, [(leaf.shape, leaf.stride(), leaf.dtype, leaf.device) for leaf in leaves]
        try:
            graph = next((graph for known, graph in graphs if known == kind), None)
            if graph is None:
                graph = _graph(function, spec, leaves)
                graphs.append((kind, graph))
            return graph(leaves)
        except Exception as error:
            failed = True
            warnings.warn(
                f"Updates run uncompiled, which takes about twice the time: {_reason(error)}.",
                RuntimeWarning,
                stacklevel=2,
            )
        return function(*args)

    return call


def _graph(
    function: Callable[..., Any], spec: TreeSpec, inputs: list[Tensor]
) -> Callable[[list[Tensor]], Any]:
    """The function of arguments like these, given their tensors, as one compiled graph."""
    returned: TreeSpec | None = None

    def flat(*leaves: Tensor) -> list[Any]:
        nonlocal returned
        out, returned = tree_flatten(function(*tree_unflatten(list(leaves), spec)))
        return out

    # No size is a symbol, but inductor (torch 2.13) caches nothing where none could be.
    fake = FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True)
    stand_ins = [fake.from_tensor(each, static_shapes=True) for each in inputs]
    with torch.random.fork_rng():  # a compiler draws numbers of its own
        # As under torch.compile, nothing looks at values to check them.
        with torch.compiler._compile_session_context():
            trace = make_fx(
                flat, decomposition_table=faster_products(), _allow_non_fake_inputs=True
            )
            traced = trace(*stand_ins)
        # Calls between kernels in C++ rather than Python: 3 to 5 % of an update.
        options = _options() | {"cpp_wrapper": all(each.device.type == "cpu" for each in inputs)}
        options["post_grad_custom_pre_pass"] = _ComputeOnce()
        with torch.no_grad(), tracing(TracingContext(fake)), _inductor.config.patch(options):
            run = _inductor.compile(traced, stand_ins)

    def call(leaves: list[Tensor]) -> Any:
        with torch.no_grad():
            return tree_unflatten(run(*leaves), returned)

    return call


class _ComputeOnce(CustomGraphPass):
    """Equal operations of a graph become one: two losses ask the same critic for the same states.

    Inductor (torch 2.13) merges them in graphs that autograd splits in two, and in no others. Two
    draws are never equal, though PyTorch's own list of operations that draw lacks ``randn_like``.
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
    """Record what a function of a tensordict does on the GPU and play it back, as one launch."""
    # It takes TensorDicts out of PyTree for good (tensordict 0.14.3), unless they are not in it.
    with _exclude_td_from_pytree():
        return CudaGraphModule(function, in_keys=[], out_keys=[], warmup=5)


def _options() -> dict[str, Any]:
    """What makes inductor (torch 2.13) draw as PyTorch does, and compile where a path has a space.

    It hands the folder of PyTorch's libraries, its cache and its precompiled headers to a shell
    without quotes.
    """
    from torch._inductor.runtime.cache_dir_utils import cache_dir, default_cache_dir
    from torch.utils.cpp_extension import TORCH_LIB_PATH

    options: dict[str, Any] = {"fallback_random": True}
    if _is_split(cache_dir()):
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = f"/tmp/torchinductor_{os.getuid()}"
    if _is_split(default_cache_dir()):  # where its headers are, whatever the cache is
        options["cpp_cache_precompile_headers"] = False
    if _is_split(TORCH_LIB_PATH):
        # A kernel takes its symbols from the process instead, where PyTorch shows it them.
        options["aot_inductor.link_libtorch"] = False
        library = os.path.join(TORCH_LIB_PATH, "libtorch_cpu.so")
        with suppress(OSError):  # elsewhere than on Linux it has another name
            ctypes.CDLL(library, mode=os.RTLD_GLOBAL | os.RTLD_NOLOAD)
    return options


def _is_split(path: str) -> bool:
    return os.name == "posix" and any(character in path for character in " \t\n'\"\\")


def _reason(error: BaseException) -> str:
    """Why a compilation failed and what helps, in half a sentence."""
    from torch._inductor.exc import CppCompileError, InvalidCxxCompiler, TritonMissing

    for cause in _causes(error):
        match cause:
            case InvalidCxxCompiler():
                names = torch._inductor.config.cpp.cxx
                name = names if isinstance(names, str) else names[-1]
                return (
                    f"there is no C++ compiler ({name} does not run); install one "
                    "(apt install g++), or name one in the variable CXX"
                )
            case TritonMissing():
                return "Triton, which compiles for GPUs, is not installed; pip install triton"
            case CppCompileError() if "Python.h" in cause.output:
                return "the headers of Python are missing; install them (apt install python3-dev)"
            case CppCompileError():
                return f"the C++ compiler failed ({_first_line(cause.output)}); {_ELSE}"
            case OSError() if cause.filename:
                return (
                    f"{cause.filename}: {cause.strerror}; name a folder that can be written, and "
                    "has room, in the variable TORCHINDUCTOR_CACHE_DIR"
                )
    told = getattr(error, "inner_exception", None) or error
    return f"{type(told).__name__}: {_first_line(str(told))}; {_ELSE}"


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and those that it came from, the innermost first."""
    if error is not None:
        yield from _causes(getattr(error, "inner_exception", None) or error.__cause__)
        yield error


def _first_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    telling = [line for line in lines if "error" in line or "cannot" in line]
    return (telling or lines or ["without a word"])[0].rstrip(".")
