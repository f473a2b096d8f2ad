"""Crossing triangles, and how far skin sticks out through cloth, in one compiled pass each (``hood/native/crossing.cpp``).

The rules are those of :mod:`hood.mesh.penetration.crossing` and :mod:`hood.mesh.penetration.exposure`, whose numpy forms are
the reference and take over where there is no compiler.
"""

from __future__ import annotations

import ctypes
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from hood import native
from hood.native.arguments import COUNT, POINTER, REAL, fields, num_parts
from hood.native.build import CROSSING_FLAGS, BuildError, build

_SOURCE = Path(native.__file__).with_name("crossing.cpp")
#: Rows that there is room for at first; more are asked for where these do not suffice.
_ROOM = 4096
#: Triangles of a part that is worth a thread.
_FACES = 1000
#: Triangles of a leaf, as in the source.
_WIDE = 8


class _Eights(ctypes.Structure):
    """``Eights`` of ``eights.h``."""

    _fields_ = [
        *fields("num_vertices num_faces num_leaves", COUNT),
        *fields("pos faces order vertex corner normal boxes groups has_normals", POINTER),
    ]


class _Rows(ctypes.Structure):
    _fields_ = [("room", COUNT * 3), ("found", COUNT * 3), *fields("pairs first_edges second_edges", POINTER)]


class _Depth(ctypes.Structure):
    _fields_ = [
        *fields("num_vertices num_faces num_edges num_skin num_pairs num_cuts", COUNT),
        *fields("pos faces edges open_edge on_rim order skin_pos skin_faces first around pairs cuts", POINTER),
        *fields("reach behind nearest", REAL),
    ]


class Eights:
    """Faces of a topology in eights that lie together, for as many passes as there are positions of it.

    What is found does not depend on the order.

    Args:
        faces: (F, 3).
        pos: (V, 3) m, a shape to order the faces by.
    """

    def __init__(self, faces: np.ndarray, pos: np.ndarray) -> None:
        lib = library()
        assert lib is not None
        self.faces = _whole(faces)
        count = len(self.faces)
        leaves = -(-count // _WIDE)
        self.order = np.zeros(_WIDE * leaves, np.int32)
        self.order[:count] = np.arange(count)
        shapes = {"corner": (leaves, 9, _WIDE), "normal": (leaves, 3, _WIDE), "boxes": (leaves, 6, _WIDE)}
        # An eighth, an eighth of that and so on, each rounded up.
        shapes["groups"] = (leaves // 7 + 12, 6, _WIDE)
        self._arrays: dict[str, np.ndarray] = {name: np.empty(shape) for name, shape in shapes.items()}
        self._arrays |= {"faces": self.faces, "order": self.order, "vertex": np.empty((leaves, 3, _WIDE), np.int32)}
        self._arrays["has_normals"] = np.empty(leaves, np.uint8)
        self._structure = _Eights(num_faces=count, num_leaves=leaves, **_addresses(self._arrays))
        centre = np.nan_to_num(np.where(np.isfinite(pos), pos, 0.0)[self.faces].mean(axis=1))
        lib.crossing_order(ctypes.byref(self._structure), POINTER(centre.ctypes.data))

    @cached_property
    def incidence(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the faces of each vertex begin (V + 1,), V the largest one with a face, and those faces (3F,), ascending."""
        corners = self.faces.reshape(-1)
        first = np.concatenate([[0], np.cumsum(np.bincount(corners))])
        return first, np.argsort(corners, kind="stable") // 3

    def at(self, pos: np.ndarray) -> _Eights:
        """With positions (V, 3), float64 without gaps, that must outlive its use."""
        self._structure.num_vertices, self._structure.pos = len(pos), pos.ctypes.data
        return self._structure


@cache
def library() -> ctypes.CDLL | None:
    """The compiled passes; None without a compiler."""
    try:
        lib = build(_SOURCE, CROSSING_FLAGS)
    except BuildError:
        return None
    lib.crossing_depth.restype = REAL
    return lib


def eights(faces: np.ndarray, pos: np.ndarray) -> Eights | None:
    """Those of faces (F, 3), of which positions (V, 3) show one shape; None without a compiler."""
    return None if library() is None else Eights(faces, pos)


def find_crossings(first: Eights, pos: np.ndarray, second: Eights, other_pos: np.ndarray, touch: float) -> list[np.ndarray]:
    """The three tables of :class:`hood.mesh.penetration.crossing.Crossings` at positions (V, 3) and (W, 3); those of pairs
    within one mesh where ``second`` is ``first``.

    Args:
        touch: distance from a plane, in units of the size of the scene, up to which a corner lies in it.
    """
    lib = library()
    assert lib is not None
    places = _double(pos), _double(other_pos)
    meshes = ctypes.byref(first.at(places[0])), ctypes.byref(second.at(places[1]))
    parts = num_parts(len(first.faces), _FACES)
    room = [_ROOM] * 3
    while True:
        tables = [np.empty((count, width), np.int64) for count, width in zip(room, (2, 3, 3), strict=True)]
        rows = _Rows((COUNT * 3)(*room), (COUNT * 3)(), *(table.ctypes.data for table in tables))
        lib.crossing_find(*meshes, COUNT(first is second), REAL(touch), COUNT(parts), ctypes.byref(rows))
        found = list(rows.found)
        if all(count <= most for count, most in zip(found, room, strict=True)):
            return [table[:count] for table, count in zip(tables, found, strict=True)]
        room = [max(count, most) for count, most in zip(found, room, strict=True)]


def depth(
    cloth: Eights,
    pos: np.ndarray,
    skin: Eights,
    skin_pos: np.ndarray,
    sheet: tuple[np.ndarray, np.ndarray, np.ndarray],
    cut: tuple[np.ndarray, np.ndarray],
    rules: tuple[float, float, float],
) -> float:
    """What :func:`hood.mesh.penetration.exposure.skin_depth` finds.

    Args:
        sheet: edges (E, 2), open_edge (F, 3) and on_rim (V,) of :class:`hood.mesh.penetration.exposure.Sheet`.
        cut: pairs and first_edges of :class:`hood.mesh.penetration.crossing.Crossings`, unique and sorted.
        rules: reach [m], least cosine to straight inwards, and least clearance in units of the distance.
    """
    lib = library()
    assert lib is not None
    places, (first, around) = (_double(pos), _double(skin_pos)), skin.incidence
    starts = np.concatenate([first, np.full(max(len(places[1]) + 1 - len(first), 0), first[-1])])
    open_edge, on_rim = (np.ascontiguousarray(flags, np.uint8) for flags in sheet[1:])
    given = {"pos": places[0], "faces": cloth.faces, "edges": _whole(sheet[0]), "open_edge": open_edge, "on_rim": on_rim}
    given |= {"order": cloth.order, "skin_pos": places[1], "skin_faces": skin.faces, "first": starts, "around": around}
    given |= {"pairs": _whole(cut[0]), "cuts": _whole(cut[1])}
    counts = [len(table) for table in (places[0], cloth.faces, sheet[0], places[1], *cut)]
    problem = _Depth(*counts, **_addresses(given))
    problem.reach, problem.behind, problem.nearest = rules
    return float(lib.crossing_depth(ctypes.byref(problem)))


def _addresses(arrays: dict[str, np.ndarray]) -> dict[str, int]:
    return {name: array.ctypes.data for name, array in arrays.items()}


def _double(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float64)


def _whole(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.int64)
