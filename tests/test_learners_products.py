"""Matrix products by oneDNN equal PyTorch's, forward and backward, for any strides."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch import Tensor

from torchrl_etl.learners import products
from torchrl_etl.learners.compiled import compiled
from torchrl_etl.learners.products import faster_products, is_amd, product


@pytest.fixture(params=[("AVX512", True), ("AVX512", False), ("AVX2", True)], ids=str)
def processor(request, monkeypatch):
    """Vector instructions, and whether the processor is AMD's."""
    capability, amd = request.param
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(products, "is_amd", lambda: amd)
    faster_products.cache_clear()
    yield request.param
    faster_products.cache_clear()


def layouts(rows: int, columns: int) -> dict[str, Tensor]:
    return {
        "dense": torch.randn(rows, columns),
        "transposed": torch.randn(columns, rows).t(),
        "columns of a larger one": torch.randn(rows, columns + 5)[:, 2:-3],
    }


@pytest.mark.parametrize("bias", [None, torch.linspace(-1, 1, 24)])
@pytest.mark.parametrize("left", layouts(1, 1))
@pytest.mark.parametrize("right", layouts(1, 1))
def test_product_equals_pytorchs(left, right, bias):
    a, b = layouts(32, 20)[left], layouts(20, 24)[right]
    expected = a @ b if bias is None else torch.addmm(bias, a, b)
    torch.testing.assert_close(product(a, b, bias), expected, rtol=1e-5, atol=1e-5)


def test_products_are_replaced_only_with_avx_512_on_amds_processors(processor):
    assert bool(faster_products()) == (processor == ("AVX512", True))


def test_vendor_is_read_from_what_the_system_tells(tmp_path, monkeypatch):
    (tmp_path / "intel").write_text("processor\t: 0\nvendor_id\t: GenuineIntel\n")
    (tmp_path / "amd").write_text("processor\t: 0\nvendor_id\t: AuthenticAMD\n")
    assert is_amd(tmp_path / "amd") and not is_amd(tmp_path / "intel")
    name = "AMD64 Family 25 Model 1 Stepping 1, AuthenticAMD"
    monkeypatch.setattr(products.platform, "processor", lambda: name)
    assert is_amd(tmp_path / "no such file")


@pytest.mark.slow
def test_compiled_gradients_of_large_and_small_products_equal_eager_ones(processor):
    features = torch.randn(64, 33)
    weights = [
        torch.randn(n, m).div(m**0.5).requires_grad_() for n, m in ((40, 66), (40, 40), (1, 40))
    ]

    def gradients(features: Tensor) -> list[Tensor]:
        first, second, last = weights
        # Some columns of a weight, as when the others multiply an input shared by the batch, and
        # one column as the bias.
        hidden = torch.nn.functional.linear(features, first[:, 3:36], first[:, 0]).tanh()
        hidden = hidden + last[0]
        value = torch.nn.functional.linear(hidden @ second, last)
        return list(torch.autograd.grad(value.square().mean(), weights))

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of an update that cannot be compiled
        fast = compiled(gradients)(features)
    torch.testing.assert_close(fast, gradients(features), rtol=1e-4, atol=1e-6)
