"""Blocks of the network by the compiled kernels: an edge update, or the layers behind the first one of any perceptron.

The same functions as :func:`hood.model.network.message_passing.update_edges` and :meth:`hood.model.network.mlp.MLP.tail`, which
stay the reference. Latents, factors of products and what is kept for the backward pass are in the precision of the input; sums,
biases, layer norm, residual and the gradients of parameters are float32.

Which kernels a network takes on a CPU: torch's own, or ``block.cpp``, compiled where it runs.

The compiled ones take a tile of rows through all layers of a block in registers and first-level cache, forward and backward:
no array between two layers is written to memory unless the gradient needs it, and nothing passes over a tile twice. They need a
C++ compiler and a processor with AVX2 or AVX-512 or of 64-bit ARM, are compiled once per user, width and precision (some
seconds) and kept in the user's cache folder. They work on one thread. bfloat16 needs AVX512_BF16; its products are by AMX where
the processor has it.
"""

from __future__ import annotations

import ctypes
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hood import native
from hood.model.graph.builder import EdgeSet
from hood.model.kernels import network
from hood.native.arguments import COUNT, POINTER
from hood.native.build import BuildError, build, processor
from hood.tensors.dense import is_whole

#: ``torch``: torch's operations, everywhere; ``compiled``: the blocks of the network in C++; ``fused``: whole passes of an
#: inference in C++ (:mod:`hood.model.kernels.network`), gradients by torch's operations.
KERNELS = ("torch", "compiled", "fused")
#: Widths of latents are a multiple of this: numbers in the widest register.
_LANES = 16
SOURCE = Path(native.__file__).with_name("block.cpp")
_FLAGS = ("-O3", "-std=c++17", "-shared", "-fPIC", "-Wno-psabi")
#: For what torch finds that the processor can do; it can be told to find less (``ATEN_CPU_CAPABILITY``).
_VECTOR_FLAGS = {"AVX512": ("-mfma", *(f"-mavx512{part}" for part in ("f", "bw", "dq", "vl"))), "AVX2": ("-mavx2", "-mfma")}
_HALF_FLAGS = ("-mavx512bf16",)
_TILE_FLAGS = ("-mamx-tile", "-mamx-bf16")
#: Widths of latents are a multiple of this for AMX: the terms that one of its instructions adds up.
TILE_LANES = 32


def _fields(*groups: str | tuple[str, type]) -> list[tuple[str, type]]:
    named = [(name, POINTER) for group in groups if isinstance(group, str) for name in group.split()]
    return [("count", COUNT), *named, *(group for group in groups if isinstance(group, tuple))]


class Block(ctypes.Structure):
    """``Block`` of ``block.cpp``."""

    _fields_ = _fields(
        "x table receivers senders first second third bias_2 bias_3 scale shift residual out received one two hat rstd",
        ("wide", COUNT),
        ("eps", ctypes.c_double),
    )


class Gradient(ctypes.Structure):
    """``Gradient`` of ``block.cpp``."""

    _fields_ = _fields(
        "grad grad_sum receivers senders x one two hat rstd first second third scale grad_first grad_second grad_third "
        "grad_bias_2 grad_bias_3 grad_scale grad_shift grad_x grad_table",
        ("wide", COUNT),
    )


def check_kernels(name: str, precision: str, width: int, device: torch.device | None = None) -> None:
    """Raise ValueError unless ``name`` is a choice that works here for latents of ``width`` columns in ``precision``."""
    if name not in KERNELS:
        raise ValueError(f"kernels is {name!r}; choose {', '.join(KERNELS[:-1])} or {KERNELS[-1]}")
    if name == "torch":
        return
    if device is not None and device.type != "cpu":
        raise ValueError(f"kernels={name} are for device=cpu, not {device.type}; use kernels=torch")
    if name == "fused":
        _check_fused(precision, width)
        return
    if width % _LANES:
        raise ValueError(f"kernels=compiled need latents of a multiple of {_LANES} columns, not {width}; use kernels=torch")
    if _vector_flags() is None:
        raise ValueError("kernels=compiled need a processor with AVX2 or AVX-512; use kernels=torch")
    if precision == "bf16" and not _multiplies_bfloat16():
        raise ValueError("kernels=compiled with precision=bf16 need a processor with AVX512_BF16; use kernels=torch")
    library(width, precision == "bf16")


def _check_fused(precision: str, width: int) -> None:
    if precision != "fp32":
        raise ValueError(f"kernels=fused compute in precision=fp32, not {precision}; use kernels=compiled or kernels=torch")
    try:
        network.check_width(width)
    except BuildError as error:
        raise ValueError(f"kernels=fused: {error} or use kernels=torch") from error


def _capability() -> str:
    return torch.backends.cpu.get_cpu_capability()


def _vector_flags() -> tuple[str, ...] | None:
    """For the compiler; None for a processor that lacks the vectors. All of 64-bit ARM have theirs."""
    return () if platform.machine() in ("aarch64", "arm64") else _VECTOR_FLAGS.get(_capability())


def panel(width: int) -> int:
    """Columns of ``width`` whose sums are in registers at a time; tiles of AMX take 32. The registers of AVX-512 are twice as
    many as those of AVX2, and hold twice the numbers."""
    choices = (64, 32, 48, _LANES) if _capability() == "AVX512" else (_LANES,)
    return next(columns for columns in choices if width % columns == 0)


def _call(function: str, values: ctypes.Structure, width: int, half: bool) -> None:
    """Run ``forward`` on a :class:`Block` or ``backward`` on a :class:`Gradient`."""
    getattr(library(width, half), function)(ctypes.byref(values))


def point(values: Block | Gradient, **tensors: Tensor | None) -> None:
    """Let fields of ``values`` point to tensors; these have to outlive the call and be contiguous."""
    for name, tensor in tensors.items():
        assert tensor is None or tensor.is_contiguous(), f"{name} has gaps"
        setattr(values, name, None if tensor is None else tensor.data_ptr())


@cache
def library(width: int, half: bool) -> ctypes.CDLL:
    """The compiled blocks for latents of ``width`` columns in bfloat16 or float32.

    Raises:
        ValueError: there is no compiler, or it fails.
    """
    shape = (f"-DWIDTH={width}", f"-DPANEL={panel(width)}", f"-DHALF={int(half)}")
    flags = [*_FLAGS, *(_vector_flags() or ()), *shape, *(_HALF_FLAGS if half else ())]
    if half and width % TILE_LANES == 0 and "amx_bf16" in processor().split():
        with suppress(BuildError):  # a compiler that does not know of them
            lib = build(SOURCE, [*flags, *_TILE_FLAGS])
            if lib.tiles_are_given():
                return lib
    try:
        return build(SOURCE, flags)
    except BuildError as error:
        raise ValueError(f"kernels=compiled: {error} or use kernels=torch") from error


def why_slow(precision: str, device: torch.device) -> str:
    """Why a precision is slower than float32 on this processor; empty where it is not, and where that is not known."""
    abilities = set(processor().split())
    known = any(word.startswith(("sse", "asimd")) for word in abilities)  # those that every processor lists
    if precision != "bf16" or device.type != "cpu" or not known or abilities & {"avx512_bf16", "amx_bf16", "bf16"}:
        return ""
    return "this processor has no instructions for bfloat16 (AVX512_BF16), and a network is several times slower than in fp32"


def _multiplies_bfloat16() -> bool:
    supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)  # missing in other versions of torch
    return _capability() == "AVX512" and supported is not None and bool(supported())


def applies(x: Tensor, parameters: tuple[Tensor, ...]) -> bool:
    """Whether a block of ``x`` (N, d) can go this way: float32 or bfloat16 on a CPU, not traced, float32 parameters, as many
    outputs as inputs, d a multiple of :data:`hood.model.kernels.block.LANES`."""
    if type(x) is not Tensor or x.device.type != "cpu" or is_whole() or torch.compiler.is_compiling():
        return False
    square = parameters[0].shape == parameters[2].shape == (x.shape[1], x.shape[1]) and x.shape[1] % _LANES == 0
    known = x.dtype in (torch.float32, torch.bfloat16)
    return known and square and all(p.dtype == torch.float32 for p in parameters)


class Setting(NamedTuple):
    """What a block is told besides its tensors."""

    keep: bool
    eps: float
    edges: EdgeSet | None = None  # of an edge update
    overwrite: bool = False  # the latents given may be used for the new ones


def update_edges_compiled(
    latent: Tensor, table: Tensor, to_edge: Tensor, setting: Setting, *parameters: Tensor
) -> tuple[Tensor, Tensor]:
    """New edge latents (N, d) and the sums at the receivers (R, d) from a table (R, 2d) of the first layer's node parts."""
    result: tuple[Tensor, Tensor] = _Compiled.apply(latent, table, to_edge, None, setting, *parameters)
    return result


def tail_compiled(hidden: Tensor, residual: Tensor | None, setting: Setting, *parameters: Tensor) -> Tensor:
    """Second and third layer, layer norm and residual, (N, d), from the first layer's output before its ReLU."""
    result: Tensor = _Compiled.apply(hidden, None, None, residual, setting, *parameters)
    return result


class _Compiled(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        table: Tensor | None,
        first: Tensor | None,
        residual: Tensor | None,
        setting: Setting,
        *parameters: Tensor,
    ) -> Tensor | tuple[Tensor, Tensor]:
        given, x = x, x.contiguous()
        second, bias_2, third, bias_3, scale, shift = (p.contiguous() for p in parameters)
        weights = [None if w is None else panels(w, x.dtype) for w in (first, second, third)]
        other = x if table is not None else None if residual is None else residual.contiguous()
        out = x if setting.overwrite else torch.empty_like(x if other is None else other)
        received = None if table is None else x.new_zeros(table.shape[0], x.shape[1])
        kept = [torch.empty_like(x) for _ in range(3)] + [x.new_empty(len(x), dtype=torch.float32)] if setting.keep else []
        values = Block(count=len(x), wide=int(out.dtype == torch.float32), eps=setting.eps)
        table = None if table is None else table.contiguous()
        point(values, x=x, table=table, residual=other, out=out, received=received, **dict(zip(KEPT, kept, strict=False)))
        point(values, first=weights[0], second=weights[1], third=weights[2])
        point(values, bias_2=bias_2, bias_3=bias_3, scale=scale, shift=shift)
        if setting.edges is not None:
            point(values, receivers=setting.edges.local_receivers, senders=setting.edges.local_senders)
        _call("forward", values, x.shape[1], x.dtype == torch.bfloat16)
        if setting.keep:
            ctx.save_for_backward(given, first, *parameters, *kept)
            ctx.edges, ctx.rows = setting.edges, 0 if table is None else len(table)
            ctx.set_materialize_grads(False)  # of the last step's edges there are none
        return out if received is None else (out, received)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor | None, grad_sum: Tensor | None = None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors  # once: under activation checkpointing a second look would compute them again
        x, first, parameters, kept = tensors[0].contiguous(), tensors[1], tensors[2:8], tensors[8:]
        edges: EdgeSet | None = ctx.edges
        grad = None if grad is None else grad.contiguous()
        grads = [torch.zeros_like(p, memory_format=torch.contiguous_format) for p in parameters]
        grad_first = None if first is None else torch.zeros_like(first, memory_format=torch.contiguous_format)
        grad_x = torch.empty_like(x)
        values = Gradient(count=len(x), wide=int(grad is not None and grad.dtype == torch.float32))
        weights = [None if w is None else panels(w.t(), x.dtype) for w in (first, parameters[0], parameters[2])]
        scale = parameters[4].contiguous()
        point(values, x=x, grad=grad, grad_x=grad_x, **dict(zip(KEPT, kept, strict=True)))
        point(values, first=weights[0], second=weights[1], third=weights[2], scale=scale, grad_first=grad_first)
        point(values, **dict(zip(PARAMETERS, grads, strict=True)))
        grad_table = None
        if edges is not None:
            grad_sum = None if grad_sum is None else grad_sum.contiguous()
            grad_table = x.new_zeros(ctx.rows, 2 * x.shape[1], dtype=torch.float32)
            point(values, grad_sum=grad_sum, grad_table=grad_table)
            point(values, receivers=edges.local_receivers, senders=edges.local_senders)
        _call("backward", values, x.shape[1], x.dtype == torch.bfloat16)
        residual = grad if ctx.needs_input_grad[3] else None
        return grad_x, None if grad_table is None else grad_table.to(x.dtype), grad_first, residual, None, *grads


#: Fields of the kept tensors, and of the gradients of the parameters in the order of :meth:`MLP.tail_parameters`.
KEPT = ("one", "two", "hat", "rstd")
PARAMETERS = ("grad_second", "grad_bias_2", "grad_third", "grad_bias_3", "grad_scale", "grad_shift")


def panels(weight: Tensor, dtype: torch.dtype) -> Tensor:
    """``weight`` (out, in) for the kernels' x Wᵀ: panels of columns of Wᵀ, in each the terms of a product one after the other,
    with bfloat16 two of them next to each other."""
    outputs, inputs = weight.shape
    pair = 2 if dtype == torch.bfloat16 else 1
    columns = panel(outputs)
    terms = weight.t().to(dtype).reshape(inputs // pair, pair, outputs // columns, columns)
    return terms.permute(2, 0, 3, 1).contiguous()
