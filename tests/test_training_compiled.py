"""Compiled updates: a failed compilation warns once, and values are those of eager updates."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch._inductor.utils import fresh_cache
from torch.utils._pytree import tree_flatten

from tests.configs import ROOT, tiny
from tests.runs import numbers
from torchrl_etl.experiment import Experiment
from torchrl_etl.learners.compiled import compiled, cuda_graph
from torchrl_etl.training import resumed_config

NOWHERE = {"cpp.cxx": (None, "/nowhere/g++")}


def slope(x: torch.Tensor) -> torch.Tensor:
    noise = torch.randn(4)
    return torch.autograd.grad((x.exp() * noise).sum(), x)[0]


def a_branch_on_a_value(x: torch.Tensor) -> torch.Tensor:
    return slope(x) if x.sum() < 1 else x


def refuse(graph: torch.fx.Graph) -> None:
    raise ValueError("this graph cannot be lowered")


@pytest.mark.parametrize(
    ("function", "patch", "words"),
    [
        (slope, {"post_grad_custom_post_pass": refuse}, "ValueError: this graph cannot be lowered"),
        (slope, NOWHERE, r"no C\+\+ compiler \(/nowhere/g\+\+ does not run\); install one"),
        (slope, {"cpp.cxx": (None, "false")}, "no C"),
        (a_branch_on_a_value, {}, "compile=false skips compilation"),
    ],
)
def test_failed_compilation_warns_and_gives_the_uncompiled_values(function, patch, words):
    x = torch.linspace(-1, 1, 4, requires_grad=True)
    call = compiled(function)
    outs = []
    with fresh_cache(), torch._inductor.config.patch(patch):
        torch.manual_seed(0)
        with pytest.warns(RuntimeWarning, match=f"^Updates run uncompiled.*{words}"):
            outs.append(call(x))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            outs.append(call(x))  # warns only once
    torch.manual_seed(0)
    assert torch.equal(torch.stack(outs), torch.stack([function(x), function(x)]))


def test_compiled_losses_share_products_but_not_changed_state():
    weight = torch.randn(20, 24, requires_grad=True)
    count, graphs = torch.ones(()), []

    def gradient(x: torch.Tensor) -> list[torch.Tensor]:
        seen = count.clone()
        first, before = (x @ weight).square().sum(), 2 * seen
        seen += 1
        second, after = (x @ weight.detach()).sum() * weight.sum(), 2 * seen
        return [torch.autograd.grad(first + second, weight)[0], before, after]

    x = torch.randn(32, 20)
    with torch._inductor.config.patch(post_grad_custom_post_pass=graphs.append):
        found = compiled(gradient)(x)
    torch.testing.assert_close(found, gradient(x), rtol=1e-4, atol=1e-4)
    aten = torch.ops.aten  # inductor adds what follows a product to it
    kinds = aten.mm.default, aten.addmm.default, torch.ops.torchrl_etl.product.default
    # x @ weight, and in the gradient of its squares
    assert sum(node.target in kinds for node in graphs[0].nodes) == 2


def test_compiled_random_draws_are_not_merged():
    def drawn(x: torch.Tensor) -> list[torch.Tensor]:
        return [torch.randn_like(x) + 1, torch.randn_like(x) + 1, x.clone().uniform_()]

    outs = []
    for function in (compiled(drawn), drawn):
        torch.manual_seed(0)
        outs.append(function(torch.zeros(8, 5)))
    torch.testing.assert_close(*outs)


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="a folder nobody can write to")
def test_another_number_of_threads_is_compiled_for_once():
    """Inductor's kernels run on as many threads as PyTorch had when they were generated."""
    traced_on = []

    @compiled
    def double(x: torch.Tensor) -> torch.Tensor:
        traced_on.append(torch.get_num_threads())
        return 2 * x

    before = torch.get_num_threads()
    try:
        for threads in (2, 1, 2, 1):
            torch.set_num_threads(threads)
            assert double(torch.ones(3)).tolist() == [2, 2, 2]
    finally:
        torch.set_num_threads(before)
    assert traced_on == [2, 1]


def test_unwritable_compile_cache_is_named_with_its_variable(monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "/sys/kernel")
    x = torch.linspace(-1, 1, 4, requires_grad=True)
    with pytest.warns(RuntimeWarning, match=r"/sys/kernel.*TORCHINDUCTOR_CACHE_DIR"):
        assert compiled(slope)(x).shape == (4,)


@pytest.mark.slow
def test_resume_with_failed_compilation_equals_an_uncompiled_run(tmp_path):
    plain, resumed = tmp_path / "plain", tmp_path / "resumed"
    Experiment(tiny("method=sac", "learn.frames=608", f"run_dir='{plain}'", "compile=false")).run()
    shutil.copytree(plain, resumed)
    shutil.rmtree(max((resumed / "checkpoints" / "learn").glob("checkpoint-*")))
    config = resumed_config(resumed, ["compile=true"])
    with (
        fresh_cache(),
        torch._inductor.config.patch(NOWHERE),
        pytest.warns(RuntimeWarning, match="Updates run uncompiled"),
    ):
        Experiment(config, resume=resumed).run()
    assert numbers(resumed) == numbers(plain)


COMPILE = """
import warnings, torch
from concurrent.futures import ThreadPoolExecutor
from torchrl_etl.learners.compiled import compiled
warnings.simplefilter("error", RuntimeWarning)
print(torch.__file__)
x = torch.zeros(64, requires_grad=True)  # enough entries for vectorized library functions
run = lambda: compiled(lambda x: torch.autograd.grad(x.exp().log1p().sum(), x)[0])(x)[:3]
print(run(), ThreadPoolExecutor(1).submit(run).result())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="folders are linked as on Linux")
def test_compilation_works_in_folders_with_spaces(tmp_path):
    spaced = tmp_path / "my folder"
    spaced.mkdir()
    (spaced / "site").symlink_to(Path(torch.__file__).parents[1])
    environment = os.environ | {
        "PYTHONPATH": f"{spaced / 'site'}:{ROOT}",
        "TMPDIR": str(spaced),
        "TORCHINDUCTOR_CACHE_DIR": str(spaced / "cache"),
    }
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMPILE],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert str(spaced) in ran.stdout and ran.stdout.count("tensor([0.5000, 0.5000, 0.5000])") == 2


def test_cuda_graph_keeps_tensordict_in_pytree():
    cuda_graph(lambda batch: batch)
    leaves, _ = tree_flatten(TensorDict({"a": torch.zeros(2)}, [2]))
    assert [type(leaf) for leaf in leaves] == [torch.Tensor]
