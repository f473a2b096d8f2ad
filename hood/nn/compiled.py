"""Which kernels a network takes on a CPU: torch's own, or ``block.cpp``, compiled where it runs.

The compiled ones take a tile of rows through all layers of a block in registers and first-level cache, forward and backward:
no array between two layers is written to memory unless the gradient needs it, and nothing passes over a tile twice. They need a
C++ compiler and a processor with AVX-512, are compiled once per user, width and precision (some seconds) and kept in the
user's cache folder. They work on one thread. Products of bfloat16 are by AMX where the processor has it.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from hood.native.build import BuildError, build, processor
from hood.native.structures import COUNT, POINTER
from hood.nn import compiled_network

#: ``torch``: torch's operations, everywhere; ``compiled``: the blocks of the network in C++; ``fused``: whole passes of an
#: inference in C++ (:mod:`hood.nn.compiled_network`), gradients by torch's operations.
KERNELS = ("torch", "compiled", "fused")
#: Widths of latents are a multiple of this: numbers in a register.
LANES = 16
SOURCE = Path(__file__).with_name("block.cpp")
_FLAGS = ("-O3", "-std=c++17", "-shared", "-fPIC", "-mfma", *(f"-mavx512{part}" for part in ("f", "bw", "dq", "vl")))
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
    if width % LANES:
        raise ValueError(f"kernels=compiled need latents of a multiple of {LANES} columns, not {width}; use kernels=torch")
    if torch.backends.cpu.get_cpu_capability() != "AVX512":
        raise ValueError("kernels=compiled need a processor with AVX-512; use kernels=torch")
    if precision == "bf16" and not _multiplies_bfloat16():
        raise ValueError("kernels=compiled with precision=bf16 need a processor with AVX512_BF16; use kernels=torch")
    library(width, precision == "bf16")


def _check_fused(precision: str, width: int) -> None:
    if precision != "fp32":
        raise ValueError(f"kernels=fused compute in precision=fp32, not {precision}; use kernels=compiled or kernels=torch")
    try:
        compiled_network.check_width(width)
    except BuildError as error:
        raise ValueError(f"kernels=fused: {error} or use kernels=torch") from error


def panel(width: int) -> int:
    """Columns of ``width`` whose sums are in registers at a time; tiles of AMX take 32."""
    return next(columns for columns in (64, 32, 48, LANES) if width % columns == 0)


def call(function: str, values: ctypes.Structure, width: int, half: bool) -> None:
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
    flags = [*_FLAGS, f"-DWIDTH={width}", f"-DPANEL={panel(width)}", f"-DHALF={int(half)}", *(_HALF_FLAGS if half else [])]
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
    return supported is not None and bool(supported())
