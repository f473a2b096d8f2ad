"""``features.cpp``: what a network is shown of a step, and what its output leads to, in inference on a CPU.

The rooms that use it have the same functions in torch: the reference, for gradients, and where there is no compiler.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from hood.native.build import optional

_SOURCE = Path(__file__).with_name("features.cpp")
_TYPES = {"p": ctypes.c_void_p, "i": ctypes.c_int64, "f": ctypes.c_float}
#: Functions of the library and their arguments: pointers, numbers of rows or columns, and real numbers.
_SIGNATURES = {
    "asinh": "piifpi",
    "size": "pifpi",
    "moved": "ppppifpi",
    "swing": "ppppifpi",
    "normals": "ppppppipi",
    "contact": "ppiffipi",
    "relative": "pppifppi",
    "strain": "ppppifpi",
    "residuals": "ppppippp",
    "base": "pppppffipp",
    "take": "pppppppiffffp",
    "fit": "pppppppipfppp",
}


class Planes(ctypes.Structure):
    """``Planes`` of ``features.cpp``; keeps alive what it points to."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("valid", "dist", "point", "next_point", "next_normal")]


class Neighbours(ctypes.Structure):
    """``Neighbours`` of ``features.cpp``."""

    _fields_ = [("count", ctypes.c_int64), ("first", ctypes.c_void_p), ("other", ctypes.c_void_p)]


@cache
def library() -> ctypes.CDLL | None:
    """The compiled functions; None without a compiler."""
    lib = optional(_SOURCE)
    if lib is None:
        return None
    for name, kinds in _SIGNATURES.items():
        function = getattr(lib, f"features_{name}")
        function.restype, function.argtypes = None, [_TYPES[kind] for kind in kinds]
    return lib


_in_torch = False


@contextmanager
def in_torch(on: bool = True) -> Iterator[None]:
    """Inside, and if ``on``, everything is computed in torch."""
    global _in_torch
    before, _in_torch = _in_torch, _in_torch or on
    try:
        yield
    finally:
        _in_torch = before


def applies(*values: Tensor | None) -> bool:
    """Whether these tensors can be computed with here: float32 on a CPU, not traced, no gradient asked for."""
    if _in_torch or torch.is_grad_enabled() or torch.compiler.is_compiling() or library() is None:
        return False
    given = [value for value in values if value is not None]
    return all(type(value) is Tensor and value.device.type == "cpu" and value.dtype == torch.float32 for value in given)


def call(name: str, *arguments: Tensor | ctypes.Structure | int | float | None) -> None:
    """Run a function of the library. Tensors have to be contiguous, in float32, int64 or bool as the function says."""
    lib = library()
    assert lib is not None
    getattr(lib, f"features_{name}")(*map(_argument, arguments))


def _argument(value: Tensor | ctypes.Structure | int | float | None) -> object:
    if isinstance(value, Tensor):
        assert value.is_contiguous(), "a table has gaps"
        return value.data_ptr()
    return ctypes.addressof(value) if isinstance(value, ctypes.Structure) else value
