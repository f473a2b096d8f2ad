"""Crossing triangles, and triangles nearest to points, in one compiled pass each (``hood/native/crossing.cpp``).

The rules are those of :mod:`hood.mesh.crossing` and :mod:`hood.mesh.skin`, whose numpy forms are the reference and take over
where there is no compiler.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np

from hood import native
from hood.native.build import BuildError, build
from hood.native.libraries import CROSSING_FLAGS
from hood.native.structures import COUNT, POINTER, REAL, fields

SOURCE = Path(native.__file__).with_name("crossing.cpp")
#: Rows that there is room for at first; more are asked for where these do not suffice.
_ROOM = 4096


class _Mesh(ctypes.Structure):
    _fields_ = [("num_faces", COUNT), *fields("pos faces", POINTER)]


class _Rows(ctypes.Structure):
    _fields_ = [("room", COUNT * 3), ("found", COUNT * 3), *fields("pairs first_edges second_edges", POINTER)]


@cache
def library() -> ctypes.CDLL | None:
    """The compiled passes; None without a compiler."""
    try:
        return build(SOURCE, CROSSING_FLAGS)
    except BuildError:
        return None


def find(
    pos: np.ndarray, faces: np.ndarray, other_pos: np.ndarray, other_faces: np.ndarray, origin: np.ndarray, touch: float
) -> list[np.ndarray] | None:
    """The three tables of :class:`hood.mesh.crossing.Crossings`, unsorted, of positions (V, 3) and (W, 3), faces (F, 3) and
    (G, 3); those of pairs within one mesh where both are the same arrays. None without a compiler."""
    lib = library()
    if lib is None:
        return None
    arrays = [_double(pos), _whole(faces), _double(other_pos), _whole(other_faces), _double(origin)]
    meshes = [_Mesh(len(arrays[i + 1]), *(array.ctypes.data for array in arrays[i : i + 2])) for i in (0, 2)]
    same, room = COUNT(other_pos is pos and other_faces is faces), [_ROOM] * 3
    while True:
        tables = [np.empty((count, width), np.int64) for count, width in zip(room, (2, 3, 3), strict=True)]
        rows = _Rows((COUNT * 3)(*room), (COUNT * 3)(), *(table.ctypes.data for table in tables))
        middle = POINTER(arrays[4].ctypes.data)
        lib.crossing_find(*(ctypes.byref(mesh) for mesh in meshes), same, middle, REAL(touch), ctypes.byref(rows))
        found = list(rows.found)
        if all(count <= most for count, most in zip(found, room, strict=True)):
            return [table[:count] for table, count in zip(tables, found, strict=True)]
        room = [max(count, most) for count, most in zip(found, room, strict=True)]


def nearest(points: np.ndarray, reach: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Of points (N, 3) the nearest of triangles (T, 3, 3) within a ``reach`` (N,): number (N,), -1 for none, weights (N, 3) of
    the nearest point, distance (N,). None without a compiler."""
    lib = library()
    if lib is None:
        return None
    given = [_double(points), _double(reach)], _double(corners)
    number, weights, dist = np.empty(len(points), np.int64), np.zeros((len(points), 3)), np.empty(len(points))
    addresses = [POINTER(array.ctypes.data) for array in (*given[0], given[1], number, weights, dist)]
    lib.crossing_nearest(COUNT(len(points)), *addresses[:2], COUNT(len(corners)), *addresses[2:])
    return number, weights, dist


def clearance(points: np.ndarray, others: np.ndarray) -> np.ndarray | None:
    """Distances (N,) from points (N, 3) to the nearest of others (M, 3); None without a compiler."""
    lib = library()
    if lib is None:
        return None
    own, far, dist = _double(points), _double(others), np.empty(len(points))
    addresses = [POINTER(array.ctypes.data) for array in (own, far, dist)]
    lib.crossing_clearance(COUNT(len(own)), addresses[0], COUNT(len(far)), *addresses[1:])
    return dist


def _double(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float64)


def _whole(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.int64)
