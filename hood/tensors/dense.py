"""Matrix products of tall arrays: in blocks of rows that stay in cache, by the fastest library that torch carries.

On a CPU torch's float32 product is MKL's, which uses half of the vector units of an AMD processor: 90 GFLOP/s where oneDNN,
which torch carries as well, reaches 190 on one core. On an Intel Xeon (Sapphire Rapids) it is the other way round, 143 by MKL
and 97 by oneDNN: processors of MKL's maker take float32 products from MKL, all others from oneDNN, and bfloat16 comes from
oneDNN everywhere (311 there with AMX). torch offers oneDNN for float32 only through the operators that its own compiler emits,
so they are tried once and the plain product takes over wherever they are missing. oneDNN compiles a kernel per shape (2–8 ms);
numbers of rows are therefore rounded up to few sizes, or the changing number of body edges would cost more than the network.
Other factors of time in this module are of one core of an AMD server CPU.

How a network may compute, and the switch of torch that TensorFloat-32 needs.

Where kernels in Triton run.

Whether derivatives go through what a network is told.
"""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional
from torch.utils._python_dispatch import _disable_current_modes

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: Bytes of one array of a block: the few in use at a time stay in cache.
BLOCK_BYTES = 2**20
#: Rows of a block are a multiple of this.
UNIT = 256
#: Gradients of weights narrower than this are faster by MKL.
_NARROW = 96


def affine(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """x Wᵀ + b of one block, (N, in) → (N, out) in the precision of ``x``, with a ReLU on request; no gradient.

    In float32 the ReLU keeps a NaN: oneDNN's own makes a zero of it, and a model that breaks would look whole.
    """
    kernel = _kernel(x.device.type, x.dtype)
    if kernel is None or _whole or not torch.backends.mkldnn.enabled:
        out = functional.linear(x, weight, bias)
        return out.relu_() if relu else out
    fused = relu and x.dtype == torch.bfloat16
    out = kernel(pad_rows(x), _packed(weight), bias, "relu" if fused else "none", [], "")
    out = out if out.shape[0] == x.shape[0] else out[: x.shape[0]]
    return out.relu_() if relu and not fused else out


def affine_plus(x: Tensor, weight: Tensor, other: Tensor, out: Tensor | None = None) -> Tensor:
    """x Wᵀ + other of one block, (N, in), (N, out) → (N, out), also written to ``out`` if given; no gradient."""
    fused = x.dtype == torch.bfloat16 and torch.backends.mkldnn.enabled and not _whole
    if not fused or _kernel(x.device.type, x.dtype) is None or padded_count(x.shape[0]) != x.shape[0]:
        product = affine(x, weight)
        return torch.add(product, other, out=product if out is None else out)
    # One product and sum: an addition in bfloat16 alone costs a quarter of the product.
    result: Tensor = torch.ops.mkldnn._linear_pointwise.binary(x, other, _packed(weight), None, "add")
    return result if out is None else out.copy_(result)


def relu_(x: Tensor) -> Tensor:
    """ReLU of one block, in place; in float32 it keeps a NaN, in bfloat16 that is left open."""
    if x.dtype == torch.bfloat16 and x.device.type == "cpu":
        # Negative numbers are negative integers of the same bits, for which a CPU has instructions: 6× faster.
        x.view(torch.int16).clamp_min_(0)
        return x
    return x.relu_()


def gram(left: Tensor, right: Tensor) -> Tensor:
    """leftᵀ right of one block, (N, a), (N, b) → (a, b): the gradient of a weight; no gradient of its own."""
    kernel = _kernel(left.device.type, left.dtype)
    if kernel is None or not torch.backends.mkldnn.enabled:
        return left.t() @ right
    if left.dtype == torch.bfloat16:  # goes to oneDNN by itself, and faster than below, where both factors are transposed
        return pad_rows(left).t() @ pad_rows(right)
    if min(left.shape[1], right.shape[1]) < _NARROW or left.shape[0] % UNIT:
        return left.t() @ right
    return kernel(left.t(), right.t(), None, "none", [], "")


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """x Wᵀ + b, (N, in) → (N, out), differentiable; weights are cast to the precision of ``x``, gradients back to theirs."""
    result: Tensor = _Linear.apply(x, weight, bias)
    return result


def sum_rows(x: Tensor, order: Tensor, offsets: Tensor, weights: Tensor | None = None) -> Tensor:
    """out[m] = Σ w[i] x[order[i]] over i in offsets[m] … offsets[m + 1], in that order: deterministic, and one kernel on a GPU.

    ``weights`` w are as many as ``order``, all 1 without them.

    On a CPU this is the fastest row sum torch has: 2× a CSR product, 2–5× ``index_add``, 15× ``segment_reduce``. Sums of
    bfloat16 are taken in float32.
    """
    return functional.embedding_bag(order, x, offsets, mode="sum", include_last_offset=True, per_sample_weights=weights)


def add_rows(target: Tensor, index: Tensor, rows: Tensor) -> Tensor:
    """``target`` (M, …) with ``rows`` (N, …) added at ``index`` (N,), in the order of the rows.

    A GPU adds at an index as it comes, and two runs differ in their last bits; so the rows are sorted by it there.
    """
    if not at_once(target):
        return target.index_add(0, index, rows)
    order, offsets = _by_index(index, len(target))
    width = math.prod(target.shape[1:])
    return target + sum_rows(rows.reshape(len(rows), width), order, offsets).reshape(target.shape)


class RowSums:
    """Σ ``values[chosen]`` at ``index``, (count, C) for ``values`` (M, C), in the order of the list.

    For sums that are taken again and again: the order in which a GPU adds is found once.

    Args:
        index: (N,) 0 … count − 1.
        chosen: (N,) rows of the values.
    """

    def __init__(self, index: Tensor, chosen: Tensor, count: int) -> None:
        self._index, self._chosen, self._count = index, chosen, count
        self._offsets: Tensor | None = None
        if at_once(index):
            order, self._offsets = _by_index(index, count)
            self._chosen = chosen[order]

    def __call__(self, values: Tensor) -> Tensor:
        if self._offsets is not None:
            return sum_rows(values, self._chosen, self._offsets)
        return values.new_zeros(self._count, values.shape[1]).index_add(0, self._index, values.index_select(0, self._chosen))


def _by_index(index: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Rows (N,) sorted by ``index`` (N,), those of one value as they were; where each of 0 … ``count`` begins, (count + 1,)."""
    order = index.argsort(stable=True)
    return order, torch.searchsorted(index[order], torch.arange(count + 1, device=index.device))


def sum_scenes(values: Tensor, scene: Tensor, num_scenes: int) -> Tensor:
    """Sum ``values`` (N,) of elements in ``scene`` (N,) to one value per scene (B,), in a fixed order on every device.

    On a GPU that takes B × N numbers for a moment: adding at an index would take N, and other bits in every run.
    """
    if not at_once(values):
        return values.new_zeros(num_scenes).index_add(0, scene, values)
    if num_scenes == 1:  # one kernel
        return values.sum().reshape(1)
    here = scene == torch.arange(num_scenes, device=scene.device).unsqueeze(1)
    return torch.where(here, values, 0.0).sum(dim=1)


_whole = False


def is_whole() -> bool:
    """Whether :func:`whole_arrays` is in force."""
    return _whole


def at_once(x: Tensor) -> bool:
    """Whether few operations on all of an array are better than many on its rows: on a GPU, whose kernels count, and in what a
    compiler is given, where every write to a part would be a copy of the whole."""
    return x.device.type != "cpu" or _whole


def index_of(values: tuple[int, ...], device: torch.device) -> Tensor:
    """A table of indices (N,) int64, made once a device, with values while a function is traced as well."""
    if device.type == "meta":  # tensors without values, to count what is done with them
        return torch.empty(len(values), dtype=torch.int64, device=device)
    return _index_of(values, device)


@cache
def _index_of(values: tuple[int, ...], device: torch.device) -> Tensor:
    with _disable_current_modes():
        return torch.tensor(values, device=device)


@contextmanager
def whole_arrays() -> Iterator[None]:
    """Inside, a CPU works as a GPU does: on everything at once, by the plain product. What is traced for a compiler has to,
    because it depends on data where the blocks of an array end and which nodes they touch."""
    global _whole
    before, _whole = _whole, True
    try:
        yield
    finally:
        _whole = before


_followed = False


def is_followed() -> bool:
    """Whether :func:`inputs_followed` is in force."""
    return _followed


@contextmanager
def inputs_followed() -> Iterator[None]:
    """Inside, autograd follows all that a network is told of a step (:func:`unfollowed`), by the forms for whole arrays, which
    write to no place twice. Training needs none of that: its gradients are by weights. The mode is one of the process: one
    thread at a time."""
    global _followed
    before, _followed = _followed, True
    try:
        with whole_arrays(), torch.enable_grad():
            yield
    finally:
        _followed = before


@contextmanager
def as_in_training() -> Iterator[None]:
    """Inside, latents are computed by blocks and compiled kernels while inputs are followed, too: both know their way back."""
    global _whole
    before, _whole = _whole, _whole and not _followed
    try:
        yield
    finally:
        _whole = before


def safe_root(square: Tensor) -> Tensor:
    """√ of numbers ≥ 0; while that is :func:`inputs_followed` the derivative at 0 is 0, which else were infinite."""
    if not _followed:
        return square.sqrt()
    some = square > 0
    return torch.where(some, torch.where(some, square, 1.0).sqrt(), 0.0)


def unfollowed(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """What a network is told has no gradient, as under ``torch.no_grad``, but while it is :func:`inputs_followed`."""

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if _followed:
            return function(*args, **kwargs)
        with torch.no_grad():
            return function(*args, **kwargs)

    return call


def blocks(x: Tensor) -> Iterator[slice]:
    """Rows of ``x`` (N, d) in blocks; a GPU gets everything at once."""
    count = x.shape[0]
    if not at_once(x):
        rows = max(BLOCK_BYTES // (x.shape[1] * x.element_size()) // UNIT * UNIT, UNIT)
    else:
        rows = max(count, 1)
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))


def padded_count(count: int) -> int:
    """Rows that an array of ``count`` should have: one of 16 sizes between a power of two and the next."""
    if count < UNIT:
        return max(16, 1 << (count - 1).bit_length())
    unit = max(UNIT, 1 << (count.bit_length() - 5))
    return -(-count // unit) * unit


def wants_padding(x: Tensor) -> bool:
    """Whether products of ``x`` want numbers of rows rounded up: all but those of MKL, which takes any."""
    return at_once(x) or _kernel(x.device.type, x.dtype) is not None


def pad_rows(x: Tensor) -> Tensor:
    """``x`` (N, …) with zeros below, up to :func:`padded_count`."""
    extra = padded_count(x.shape[0]) - x.shape[0]
    return x if extra == 0 else functional.pad(x, (0, 0) * (x.dim() - 1) + (0, extra))


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.has_bias = bias is not None
        return _in_blocks(x, weight.to(x.dtype), None if bias is None else bias.to(x.dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        grad = grad.contiguous()
        grad_x = _in_blocks(grad, weight.to(grad.dtype).t(), None) if ctx.needs_input_grad[0] else None
        grad_weight = torch.zeros_like(weight, memory_format=torch.contiguous_format)
        for part in blocks(grad):
            grad_weight += gram(grad[part], x[part])
        return grad_x, grad_weight, grad.sum(dim=0, dtype=weight.dtype) if ctx.has_bias else None


def _in_blocks(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    if not wants_padding(x):
        return affine(x, weight, bias)
    parts = list(blocks(x))
    if len(parts) <= 1 or padded_count(x.shape[0]) == x.shape[0]:
        out = affine(x, weight, bias)
        # A view of a longer array could not be changed in place under autograd.
        return out.clone() if out._is_view() else out
    out = x.new_empty(x.shape[0], weight.shape[0])
    for part in parts:
        out[part] = affine(x[part], weight, bias)
    return out


def _packed(weight: Tensor) -> Tensor:
    """``weight`` without gaps between its rows or columns: for others oneDNN falls back on a loop 5,000 times slower."""
    return weight if weight.is_contiguous() or weight.t().is_contiguous() else weight.contiguous()


@cache
def _mkl_is_faster() -> bool:
    """Whether torch's own float32 product is MKL's, on a processor of MKL's maker."""
    info = Path("/proc/cpuinfo")
    maker = info.read_text(encoding="utf-8", errors="replace") if info.exists() else platform.processor()
    return bool(torch.backends.mkl.is_available()) and "GenuineIntel" in maker


@cache
def _kernel(device: str, dtype: torch.dtype) -> Any:
    """oneDNN's linear operator where it exists, supports the precision, gives the right numbers and is faster; else None."""
    known = device == "cpu" and (dtype == torch.bfloat16 or (dtype == torch.float32 and not _mkl_is_faster()))
    if not known or torch.backends.cpu.get_cpu_capability() != "AVX512" or not torch.backends.mkldnn.is_available():
        return None
    try:
        if dtype == torch.bfloat16 and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
            return None
        kernel = torch.ops.mkldnn._linear_pointwise.default
        x = torch.linspace(-1, 1, 16 * 8).view(16, 8).to(dtype)
        weight, bias = x[:4].flip(0) + 0.5, x[0, :4]
        expected = torch.relu(x.float() @ weight.float().t() + bias.float())
        good = torch.allclose(kernel(x, weight, bias, "relu", [], "").float(), expected, atol=4 * torch.finfo(dtype).eps)
    except (AttributeError, RuntimeError, TypeError):  # another version of torch
        return None
    return kernel if good else None


#: Precisions for training and inference, and one for inference on an NVIDIA GPU alone.
PRECISIONS = ("fp32", "bf16")
TF32 = "tf32"


def check_precision(name: str, device: torch.device | None = None) -> None:
    """Raise ValueError unless ``name`` is a precision, and one of ``device`` if that is given."""
    if name not in (*PRECISIONS, TF32):
        raise ValueError(f"precision is {name!r}; choose {', '.join(PRECISIONS)} or {TF32}")
    if name == TF32 and device is not None and device.type != "cuda":
        raise ValueError(f"precision=tf32 needs device=cuda, not {device.type}: a GPU's units for it; use fp32 or bf16")


@contextmanager
def products(name: str) -> Iterator[None]:
    """Inside, products of float32 matrices on a GPU read the upper 19 bits of their factors if ``name`` is ``tf32``; sums
    stay in float32. The switch is torch's own and global, and goes back to what it was."""
    if name != TF32:
        yield
        return
    switch = torch.backends.cuda.matmul
    before = switch.fp32_precision
    switch.fp32_precision = TF32
    try:
        yield
    finally:
        switch.fp32_precision = before


_assumed = False


@contextmanager
def assumed() -> Iterator[None]:
    """Inside, the device counts as one that has these kernels: to count the kernels of a frame, and to run them by Triton's
    interpreter, on a CPU."""
    global _assumed
    before, _assumed = _assumed, True
    try:
        yield
    finally:
        _assumed = before


def has_triton(device: torch.device) -> bool:
    """Whether Triton is here and the device an NVIDIA one with tensor cores for float32 and bfloat16 (Ampere or later).
    ``HOOD_TRITON=off`` in the environment says no."""
    if os.environ.get("HOOD_TRITON", "on") == "off":
        return False
    return _assumed or (device.type == "cuda" and _supported(device))


@cache
def _supported(device: torch.device) -> bool:
    here = find_spec("triton") is not None and torch.version.hip is None
    return here and torch.cuda.get_device_capability(device) >= (8, 0)
