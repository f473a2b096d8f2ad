"""Where triangles pass through each other: between two meshes, and within one.

Everything is decided by edges that pass through faces. With the signed distances s of a triangle's corners from the other
triangle's plane, two triangles **cross** where

1. each has corners strictly on both sides of the other's plane, and
2. an edge of one, whose ends lie strictly on both sides of the other's plane, meets the other triangle, its rim included.

A corner within :data:`TOUCH` times the size of the scene of a plane lies in that plane. So triangles that touch from one side,
that lie in one plane, or that have no area do not cross anything. Whether an edge passes an edge on its left or right is
computed from the four vertices in the order of their numbers: faces that share an edge agree about it to the last bit, and
nothing slips through between them. The winding of the faces plays no role.

Positions are taken to float64 around the middle of the scene. Triangles with a corner that is not finite cross nothing. Where
there is a compiler :mod:`hood.mesh.penetration.compiled` does the same in less than a hundredth of the time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hood.mesh.penetration.boxes import overlapping_boxes
from hood.mesh.penetration.compiled import Eights, eights, find_crossings

#: Distance from a plane, in units of the size of the scene, up to which a corner lies in it.
TOUCH = 1e-10
#: Edges of a triangle whose corners ascend: start and end ascend as well.
_EDGES = np.array([[0, 1], [1, 2], [0, 2]])


class Crossings(NamedTuple):
    """What crosses between a first and a second mesh; rows are unique and sorted.

    ``pairs`` (N, 2): faces of the first, faces of the second. ``first_edges`` (K, 3): edges of the first (smaller
    vertex, larger vertex) and the face of the second that they pass through; ``second_edges`` (L, 3) the other way round.
    """

    pairs: np.ndarray
    first_edges: np.ndarray
    second_edges: np.ndarray


def crossings(
    pos: np.ndarray,
    faces: np.ndarray,
    other_pos: np.ndarray,
    other_faces: np.ndarray,
    both: tuple[Eights, Eights] | None = None,
) -> Crossings:
    """Crossings of two meshes with positions (V, 3), (W, 3) and faces (F, 3), (G, 3).

    ``both``: :func:`hood.mesh.penetration.compiled.eights` of the faces, where they are known.
    """
    pos, faces, other_pos, other_faces = _arrays(pos, faces) + _arrays(other_pos, other_faces)
    own, other = both or (eights(faces, pos), eights(other_faces, other_pos))
    if own is not None and other is not None:
        return Crossings(*find_crossings(own, pos, other, other_pos, TOUCH))
    frame = _Frame.around(pos, other_pos)
    first = _triangles(pos, faces, frame)
    second = _triangles(other_pos, other_faces, frame, within=first)
    return _collect(_crossing(first, second, pairs, frame.touch) for pairs in _near(first, second))


def self_crossings(pos: np.ndarray, faces: np.ndarray, own: Eights | None = None) -> np.ndarray:
    """Pairs (N, 2) of faces of one mesh that cross, the smaller number first; those that share a vertex are left out.

    ``own``: :func:`hood.mesh.penetration.compiled.eights` of the faces, where they are known.
    """
    pos, faces = _arrays(pos, faces)
    own = own or eights(faces, pos)
    if own is not None:
        return find_crossings(own, pos, own, pos, TOUCH)[0]
    frame = _Frame.around(pos)
    mesh = _triangles(pos, faces, frame)
    return _collect(_crossing(mesh, mesh, _apart(mesh, pairs), frame.touch) for pairs in _near(mesh, mesh)).pairs


def _arrays(pos: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(pos, dtype=np.float64).reshape(-1, 3), np.asarray(faces, dtype=np.int64).reshape(-1, 3)


class _Frame(NamedTuple):
    """Where coordinates are counted from, and the distance that counts as touching."""

    origin: np.ndarray  # (3,)
    touch: float

    @classmethod
    def around(cls, *clouds: np.ndarray) -> _Frame:
        """The frame around the finite ones of some points (N, 3)."""
        points = np.concatenate(clouds)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) == 0:
            return cls(np.zeros(3), 0.0)
        low, high = points.min(axis=0), points.max(axis=0)
        return cls(0.5 * low + 0.5 * high, TOUCH * float((high - low).max()))


class _Triangles(NamedTuple):
    """Triangles with finite corners: their vertices in ascending order, where they are and their planes."""

    numbers: np.ndarray  # (N,) in the mesh
    faces: np.ndarray  # (N, 3) ascending
    corners: np.ndarray  # (N, 3, 3)
    normal: np.ndarray  # (N, 3) unit, zero of a triangle without area


def _triangles(pos: np.ndarray, faces: np.ndarray, frame: _Frame, within: _Triangles | None = None) -> _Triangles:
    """The triangles of a mesh in a frame; those alone that reach into the box around ``within``."""
    points = pos - frame.origin
    usable = np.isfinite(points).all(axis=1)[faces].all(axis=1)
    if within is not None and len(within.numbers):
        low, high = (edge(within.corners.reshape(-1, 3), axis=0) for edge in (np.min, np.max))
        for beyond in (points < low, points > high):
            for axis in range(3):
                usable &= ~beyond[:, axis][faces].all(axis=1)
    kept = np.flatnonzero(usable)
    rows = np.sort(faces[kept], axis=1)
    corners = points[rows]
    return _Triangles(kept, rows, corners, _unit_normals(corners))


def _unit_normals(corners: np.ndarray) -> np.ndarray:
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    length, a, b = (np.sqrt(np.einsum("ni,ni->n", v, v)) for v in (normal, first, second))
    # Below this the direction is rounding alone.
    flat = length <= 16 * np.finfo(float).eps * a * b
    return normal * np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, length))[:, None]


def _near(first: _Triangles, second: _Triangles) -> Iterator[np.ndarray]:
    """Pairs of triangles whose boxes overlap."""
    return overlapping_boxes(*_boxes(first.corners), *_boxes(second.corners))


def _boxes(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (N, 3) of triangles (N, 3, 3)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _apart(mesh: _Triangles, pairs: np.ndarray) -> np.ndarray:
    """Pairs of different triangles, each once, without a common vertex."""
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    a, b = mesh.faces[pairs[:, 0]], mesh.faces[pairs[:, 1]]
    shared = np.zeros(len(pairs), dtype=bool)
    for corner in a.T:
        for other in b.T:
            shared |= corner == other
    return pairs[~shared]


def _crossing(first: _Triangles, second: _Triangles, pairs: np.ndarray, touch: float) -> Crossings:
    """Crossings among candidate ``pairs``."""
    side = _sides(first, second, pairs, touch)
    pairs, side = _straddling(pairs, side)
    other_side = _sides(second, first, pairs[:, ::-1], touch)
    pairs, other_side, side = _straddling(pairs, other_side, side)
    a, b = first.corners[pairs[:, 0]], second.corners[pairs[:, 1]]
    turns = _turns(a, b)
    hits = (side[:, _EDGES].prod(axis=2) < 0) & _inside(turns)
    other_hits = (other_side[:, _EDGES].prod(axis=2) < 0) & _inside(turns.transpose(0, 2, 1))
    crossed = hits.any(axis=1) | other_hits.any(axis=1)
    named = np.column_stack([first.numbers[pairs[:, 0]], second.numbers[pairs[:, 1]]])
    return Crossings(
        named[crossed],
        _edges(first.faces[pairs[:, 0]], named[:, 1], hits),
        _edges(second.faces[pairs[:, 1]], named[:, 0], other_hits),
    )


def _sides(mesh: _Triangles, planes: _Triangles, pairs: np.ndarray, touch: float) -> np.ndarray:
    """Side (N, 3) of the plane of ``pairs[:, 1]`` on which each corner of ``pairs[:, 0]`` lies: -1, 0 or 1."""
    i, j = pairs.T
    normal, origin = planes.normal[j], planes.corners[j, 0]
    height = np.stack([np.einsum("ni,ni->n", mesh.corners[i, corner] - origin, normal) for corner in range(3)], axis=1)
    return np.sign(height) * (np.abs(height) > touch)


def _straddling(pairs: np.ndarray, side: np.ndarray, *more: np.ndarray) -> tuple[np.ndarray, ...]:
    """The rows whose corners lie on both sides."""
    a, b, c = side.T
    both = np.flatnonzero(((a < 0) | (b < 0) | (c < 0)) & ((a > 0) | (b > 0) | (c > 0)))
    return tuple(values[both] for values in (pairs, side, *more))


def _turns(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sign (N, 3, 3) of the volume that edge i of ``a`` and edge j of ``b`` span: on which side one passes the other."""
    signs = np.empty((len(a), 3, 3))
    for i, (start, end) in enumerate(_EDGES):
        along = a[:, end] - a[:, start]
        moved = b - a[:, start, None]
        for j, (tail, head) in enumerate(_EDGES):
            signs[:, i, j] = np.sign(np.einsum("ni,ni->n", along, np.cross(moved[:, tail], moved[:, head])))
    return signs


def _inside(turns: np.ndarray) -> np.ndarray:
    """Whether each line (axis 1) passes the edges (axis 2) of a triangle on one side all the way round: (N, 3) bool."""
    a, b, c = turns[..., 0], turns[..., 1], -turns[..., 2]  # the third edge runs against the way round
    return ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))


def _edges(faces: np.ndarray, through: np.ndarray, hits: np.ndarray) -> np.ndarray:
    """Rows (K, 3) of edges, by their vertices, that pass through a face."""
    row, edge = np.nonzero(hits)
    return np.column_stack([faces[row[:, None], _EDGES[edge]], through[row]])


def _collect(parts: Iterator[Crossings]) -> Crossings:
    empty = Crossings(np.empty((0, 2), dtype=np.int64), *(np.empty((0, 3), dtype=np.int64) for _ in range(2)))
    return Crossings(*(_unique_rows(np.concatenate(group)) for group in zip(empty, *parts, strict=True)))


def _unique_rows(rows: np.ndarray) -> np.ndarray:
    """Sorted, each once; several times as fast as :func:`numpy.unique` by rows."""
    rows = rows[np.lexsort(rows.T[::-1])]
    return rows[np.r_[True, (rows[1:] != rows[:-1]).any(axis=1)][: len(rows)]]
