"""Drawing in C++ (``hood/native/picture.cpp``): the pictures of the numpy form, several times as fast."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hood import native
from hood.native.build import NATIVE_FLAGS, BuildError, build

SOURCE = Path(native.__file__).with_name("picture.cpp")

Array = NDArray[np.float64]
_POINTER, _COUNT, _REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_TRIPLE = _REAL * 3


def _fields(text: str, kind: type) -> list[tuple[str, type]]:
    return [(name, kind) for name in text.split()]


class LightValues(ctypes.Structure):
    """``Light`` of ``picture.cpp``."""

    _fields_ = [
        *_fields("map probes axes", _POINTER),
        *_fields("size num_probes", _COUNT),
        ("low", _REAL * 2),
        *_fields("scale texel", _REAL),
        *_fields("key fill key_color fill_color sky_color bounce_color", _TRIPLE),
    ]


class SeenValues(ctypes.Structure):
    """``Seen`` of ``picture.cpp``."""

    _fields_ = [
        *_fields("pos color normal screen depth faces face image", _POINTER),
        *_fields("width height", _COUNT),
        ("eye", _TRIPLE),
    ]


class FloorValues(ctypes.Structure):
    """``Floor`` of ``picture.cpp``."""

    _fields_ = [
        *_fields("dark image", _POINTER),
        *_fields("width height cells", _COUNT),
        *_fields("eye right up forward center", _TRIPLE),
        *_fields("tan_y floor cell", _REAL),
        *_fields("ground horizon zenith", _TRIPLE),
    ]


@cache
def library() -> ctypes.CDLL | None:
    """The compiled drawing; None without a compiler."""
    try:
        lib = build(SOURCE, NATIVE_FLAGS)
    except BuildError:
        return None
    lib.picture_rasterise.argtypes = [*[_POINTER] * 3, *[_COUNT] * 3, _REAL, _REAL, *[_POINTER] * 2]
    lib.picture_lit.argtypes = [_POINTER, _POINTER, _COUNT, _REAL, _POINTER]
    lib.picture_shade.argtypes = [_POINTER] * 2
    lib.picture_backdrop.argtypes = [_POINTER] * 2
    lib.picture_resolve.argtypes = [_POINTER, _COUNT, _COUNT, _POINTER]
    for name in ("picture_rasterise", "picture_lit", "picture_shade", "picture_backdrop", "picture_resolve"):
        getattr(lib, name).restype = None
    return lib


def packed(values: Any, kind: type = np.float64) -> NDArray[Any]:
    """``values`` without gaps, as C++ takes them."""
    return np.ascontiguousarray(values, dtype=kind)


def address(values: NDArray[Any]) -> int:
    """Of an array that :func:`packed` made and that outlives the call."""
    return int(values.ctypes.data)
