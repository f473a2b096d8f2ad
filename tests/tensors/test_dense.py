"""Products by whichever library: equal to torch's own, for any shape and layout of the weights."""

import pytest
import torch
from torch import Tensor

from hood.tensors import dense
from hood.tensors.dense import affine, blocks, gram, linear, pad_rows, padded_count

COUNTS = [1, 15, 16, 17, 255, 256, 257, 3000]
TOLERANCE = {torch.float32: 1e-5, torch.bfloat16: 2e-2, torch.float64: 1e-12}


def make(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=torch.float64).to(dtype)


@pytest.fixture(autouse=True, params=["MKL", "oneDNN"])
def library(request, monkeypatch):
    """Products in float32 as on processors where one or the other is faster."""
    monkeypatch.setattr(dense, "_mkl_is_faster", lambda: request.param == "MKL")
    dense._kernel.cache_clear()
    yield request.param
    dense._kernel.cache_clear()


def test_a_processor_takes_one_library(library):
    kernel = dense._kernel("cpu", torch.float32)
    assert kernel is None or library == "oneDNN"


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("count", COUNTS)
def test_affine_is_linear(count, dtype):
    x, weight, bias = make(count, 24, dtype=dtype), make(40, 24, dtype=dtype), make(40, dtype=dtype)
    expected = (x.double() @ weight.double().t() + bias.double()).to(dtype)
    for relu in (False, True):
        out = affine(x, weight, bias, relu)
        assert out.dtype == dtype
        reference = expected.relu() if relu else expected
        torch.testing.assert_close(out, reference, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


@pytest.mark.parametrize("count", [1, 300, 1024])
def test_a_relu_keeps_a_nan(count):
    x = make(count, 24)
    x[-1, 3] = float("nan")
    out = affine(x, make(40, 24), make(40), relu=True)
    assert out[-1].isnan().all()
    assert (out[:-1] >= 0).all()


def test_weights_of_any_layout():
    x, table = make(300, 32), make(32, 96)
    for weight in (table[:, 32:64], table[:, 32:64].t(), table[:, ::3], table.t()[::3].contiguous().t()):
        torch.testing.assert_close(affine(x, weight), x @ weight.t(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("width", [8, 128])
@pytest.mark.parametrize("count", [5, 256, 300])
def test_gram_is_the_product_of_the_transpose(count, width, dtype):
    left, right = make(count, width, dtype=dtype), make(count, width + 4, dtype=dtype)[:, :width].contiguous()
    expected = left.double().t() @ right.double()
    error = (gram(left, right).double() - expected).norm() / expected.norm()
    assert float(error) < TOLERANCE[dtype]


@pytest.mark.parametrize("count", [7, 300, 1024])
def test_linear_has_the_gradients_of_torchs(count, monkeypatch):
    monkeypatch.setattr(dense, "BLOCK_BYTES", 0)
    inputs = [make(count, 16).requires_grad_(), make(24, 16).requires_grad_(), make(24).requires_grad_()]
    results = []
    for function in (linear, torch.nn.functional.linear):
        out = function(*inputs)
        out = out.index_add_(0, torch.arange(count), torch.ones(count, 24))  # callers may go on in place
        results.append([out, *torch.autograd.grad((out * torch.cos(out.detach())).sum(), inputs)])
    for mine, expected in zip(*results, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-5, atol=1e-3)


def test_linear_in_low_precision_gives_gradients_to_full_weights():
    x, weight, bias = make(50, 16, dtype=torch.bfloat16), make(8, 16).requires_grad_(), make(8).requires_grad_()
    out = linear(x, weight, bias)
    out.float().sum().backward()
    assert out.dtype == torch.bfloat16
    assert weight.grad.dtype == bias.grad.dtype == torch.float32


def test_paddings_are_few_and_small():
    sizes = [padded_count(n) for n in range(1, 100_000)]
    for n, size in enumerate(sizes, start=1):
        assert n <= size
        assert size <= max(16, 2 * n)
        assert size <= 1.0625 * n + 256
    assert len(set(sizes)) < 150
    assert all(padded_count(size) == size for size in sizes[::17])


def test_padding_adds_zeros():
    assert torch.equal(pad_rows(torch.arange(1, 18)), torch.cat([torch.arange(1, 18), torch.zeros(15, dtype=torch.int64)]))
    table = make(256, 3)
    assert pad_rows(table) is table


def test_blocks_cover_every_row_once():
    x = torch.zeros(10_000, 96)
    parts = list(blocks(x))
    assert torch.equal(torch.cat([torch.arange(10_000)[p] for p in parts]), torch.arange(10_000))
    assert all((p.stop - p.start) % dense.UNIT == 0 for p in parts[:-1])
    assert list(blocks(x[:0])) == []
