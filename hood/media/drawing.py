"""Drawing in C++ (``hood/native/picture.cpp``): the pictures of the numpy form, several times as fast."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hood import native
from hood.native.build import optional
from hood.native.structures import COUNT, POINTER, REAL, fields

SOURCE = Path(native.__file__).with_name("picture.cpp")

Array = NDArray[np.float64]
_TRIPLE = REAL * 3


class LightValues(ctypes.Structure):
    """``Light`` of ``picture.cpp``."""

    _fields_ = [
        *fields("map probes axes", POINTER),
        *fields("size num_probes", COUNT),
        ("low", REAL * 2),
        *fields("scale texel", REAL),
        *fields("key fill key_color fill_color sky_color bounce_color", _TRIPLE),
    ]


class SeenValues(ctypes.Structure):
    """``Seen`` of ``picture.cpp``."""

    _fields_ = [
        *fields("pos color normal screen depth hem faces face nearness around axes image own", POINTER),
        *fields("width height num_around", COUNT),
        ("eye", _TRIPLE),
        *fields("focal reach inside", REAL),
    ]


class FloorValues(ctypes.Structure):
    """``Floor`` of ``picture.cpp``."""

    _fields_ = [
        *fields("dark image", POINTER),
        *fields("width height cells samples", COUNT),
        *fields("eye right up forward center", _TRIPLE),
        *fields("tan_y floor cell", REAL),
        *fields("ground horizon zenith", _TRIPLE),
    ]


@cache
def library() -> ctypes.CDLL | None:
    """The compiled drawing; None without a compiler."""
    lib = optional(SOURCE)
    if lib is None:
        return None
    lib.picture_rasterise.argtypes = [*[POINTER] * 3, *[COUNT] * 3, REAL, REAL, *[POINTER] * 2]
    lib.picture_lit.argtypes = [POINTER, POINTER, COUNT, REAL, POINTER]
    lib.picture_shade.argtypes = [POINTER] * 2
    lib.picture_backdrop.argtypes = [POINTER] * 2
    lib.picture_resolve.argtypes = [POINTER, COUNT, COUNT, POINTER]
    for name in ("picture_rasterise", "picture_lit", "picture_shade", "picture_backdrop", "picture_resolve"):
        getattr(lib, name).restype = None
    return lib


def packed(values: Any, kind: type = np.float64) -> NDArray[Any]:
    """``values`` without gaps, as C++ takes them."""
    return np.ascontiguousarray(values, dtype=kind)


def address(values: NDArray[Any]) -> int:
    """Of an array that :func:`packed` made and that outlives the call."""
    return int(values.ctypes.data)
