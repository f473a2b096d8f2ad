"""The number of threads of compiled loops; see ``threads.h``.

Structures and arguments as C++ takes them: types, and fields by their names.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import torch

POINTER, COUNT, REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


def fields(text: str, kind: type) -> list[tuple[str, type]]:
    """Entries of ``_fields_`` of one type, from their names with spaces between."""
    return [(name, kind) for name in text.split()]


_BYTES = ctypes.c_char * 0


def address_of(array: np.ndarray) -> int:
    """Of the first number of an array that may be written to and has no gaps (TypeError); ``array.ctypes.data`` takes 1.6 µs,
    this 0.6, and a step asks a hundred times."""
    return ctypes.addressof(_BYTES.from_buffer(array))  # type: ignore[arg-type]


SOURCE = Path(__file__).with_name("threads.h")
#: As in ``threads.h``.
MOST_PARTS = 64


def num_parts(count: int, least: int) -> int:
    """Parts of a loop over ``count`` things, each of ``least`` or more: as many as torch has threads (``OMP_NUM_THREADS``)."""
    return max(min(torch.get_num_threads(), count // least, MOST_PARTS), 1)
