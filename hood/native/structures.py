"""Structures and arguments as C++ takes them: types, and fields by their names."""

from __future__ import annotations

import ctypes

POINTER, COUNT, REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


def fields(text: str, kind: type) -> list[tuple[str, type]]:
    """Entries of ``_fields_`` of one type, from their names with spaces between."""
    return [(name, kind) for name in text.split()]
