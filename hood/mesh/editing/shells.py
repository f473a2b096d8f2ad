"""Cloth modelled with its thickness: closed surfaces whose two layers lie along each other, and sheets that are there twice."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hood.mesh import topology
from hood.mesh.editing import repair

#: Two faces lie along each other where the cosine between their normals, one turned over, is at least this.
_ALONG = 0.8
#: Of the area so much lies along other cloth at about one distance, from half of it to one and a half.
_MOST, _SPREAD = 0.75, 0.5
#: The two layers have so much of that area, and at least so many times each other's.
_BOTH, _ALIKE = 0.95, 0.6
#: Layers in one place are apart by less than this share of the thickest cloth, to either side.
_TOUCHING = 1e-6
#: Cosine between the normals of two faces with a sharp edge between them: a rim is upright on its layers.
_SHARP = 0.3
#: The rim between two layers is at most so many times as wide as they are apart.
_RIM = 2.5
#: Two groups of faces that meet in a fold have less than this share of their faces opposite each other.
_FOLDED = 0.2
#: What is narrower at the end of a layer than so many times the thickness, and lies askew [cosine], is of a rounded rim; looked
#: for so often.
_NARROW, _SAME_PLANE, _TRIMS = 0.8, 0.96, 4
#: Rays and faces that are looked at at once.
_AT_ONCE = 2_000_000


class Shell(NamedTuple):
    """The two layers of a closed surface: rows of the faces of each, the larger one first, and how far they are apart."""

    outer: np.ndarray
    inner: np.ndarray
    thickness: float


def find_shell(pos: np.ndarray, faces: np.ndarray, thickest: float) -> Shell | None:
    """The layers of a closed surface ``pos`` (V, 3), ``faces`` (F, 3), if it is cloth no thicker than ``thickest``.

    From the middle of every face a line through the cloth is followed to the nearest face that looks the other way. What has
    such a face at about the usual distance is layer; layers end at sharp edges. What is left is of the layer around it, or,
    where both are around it, of the rim between them.
    """
    faces = _wound_outwards(pos, faces)
    normal, area = _normals(pos, faces)
    gap, opposite = _gaps(pos, faces, normal, thickest)
    layer = np.isfinite(gap)
    if area[layer].sum() < _MOST * area.sum():
        return None
    usual = _median(gap[layer], area[layer])
    layer &= np.abs(gap - usual) <= _SPREAD * usual + 1e-9
    if area[layer].sum() < _MOST * area.sum():
        return None
    label = _smooth_groups(faces, normal, layer)
    rim = (_widths(pos, faces, area, label) <= _RIM * usual)[label]
    label = _unfolded(faces, layer, rim, label, opposite)
    size = np.bincount(label[layer], weights=area[layer], minlength=2)
    first, second = np.argsort(-size, kind="stable")[:2]
    if size[first] + size[second] < _BOTH * area[layer].sum() or size[second] < _ALIKE * size[first]:
        return None
    side = _grown(faces, np.where(layer & (label == first), 0, np.where(layer & (label == second), 1, -1)))
    one, other = (_trimmed(pos, faces, normal, np.flatnonzero(side == which), usual) for which in (0, 1))
    outer, inner = (one, other) if area[one].sum() >= area[other].sum() else (other, one)
    return Shell(outer, inner, usual)


def same_sheet(pos: np.ndarray, faces: np.ndarray, others: np.ndarray, tolerance: float) -> bool:
    """Whether every face of ``others`` (G, 3) lies on one of ``faces`` (F, 3), corner on corner within ``tolerance``."""
    corner = _matched(pos, faces, others, tolerance)
    return corner is not None and bool(np.isin(_keys(corner, len(pos)), _keys(faces, len(pos))).all())


def paired_sheet(pos: np.ndarray, faces: np.ndarray, others: np.ndarray, farthest: float) -> float | None:
    """The distance of two sheets of one make, such as the two sides of a cloth: as many vertices, and the same faces between
    those that lie opposite each other; None where they are of two makes, or farther apart than ``farthest``."""
    if len(faces) != len(others):
        return None
    for corner in (_matched(pos, faces, others, farthest), _in_order(faces, others)):
        if corner is None or not np.array_equal(np.sort(_keys(corner, len(pos))), np.sort(_keys(faces, len(pos)))):
            continue
        here, there = np.unique(np.stack([others.reshape(-1), corner.reshape(-1)], axis=1), axis=0).T
        if len(np.unique(here)) != len(here) or len(np.unique(there)) != len(there):
            continue
        apart = np.linalg.norm(pos[here] - pos[there], axis=1)
        if apart.max() <= farthest:
            return float(np.median(apart))
    return None


def _wound_outwards(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces of a closed surface with their normals out of it."""
    turned = faces.copy()
    flipped = repair.flipped_faces(faces)
    turned[flipped] = turned[flipped][:, ::-1]
    corners = pos[turned] - pos[turned].mean(axis=(0, 1))
    volume = float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    return turned[:, ::-1] if volume < 0.0 else turned


def _normals(pos: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (F, 3) and areas (F,)."""
    corners = pos[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1)
    return across / np.maximum(length, 1e-30)[:, None], 0.5 * length


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def _gaps(pos: np.ndarray, faces: np.ndarray, normal: np.ndarray, farthest: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance (F,) from the middle of every face, against its normal, to the nearest face that looks the other way, and that
    face; infinite and -1 where none is nearer than ``farthest``."""
    corners = pos[faces]
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for ray, face in _near(centre, radius, farthest):
        facing = (normal[ray] * normal[face]).sum(axis=1) <= -_ALONG
        ray, face = ray[facing], face[facing]
        along = (normal[face] * normal[ray]).sum(axis=1)
        way = (normal[face] * (centre[face] - centre[ray])).sum(axis=1) / along
        at = centre[ray] + way[:, None] * normal[ray]
        hit = (-way <= farthest) & (way <= _TOUCHING * farthest) & _inside(at, corners[face], normal[face])
        found.append((ray[hit], np.abs(way[hit]), face[hit]))
    ray, way, face = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((way, ray))
    first = order[np.unique(ray[order], return_index=True)[1]]
    gap, opposite = np.full(len(faces), np.inf), np.full(len(faces), -1, dtype=np.int64)
    gap[ray[first]], opposite[ray[first]] = way[first], face[first]
    return gap, opposite


def _near(centre: np.ndarray, radius: np.ndarray, farthest: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of different faces, a first and a second table (N,), that a line of the first within ``farthest`` may meet. Large
    faces are sought apart from the others: a few of them would make all pairs near."""
    usual = float(np.quantile(radius, 0.98)) * 1.01
    small, large = np.flatnonzero(radius <= usual), np.flatnonzero(radius > usual)
    tree = cKDTree(centre[small])
    step = max(1, _AT_ONCE // 64)
    for begin in range(0, len(centre), step):
        rows = np.arange(begin, min(begin + step, len(centre)))
        found = tree.query_ball_point(centre[rows], farthest + usual)
        first, second = np.repeat(rows, [len(one) for one in found]), small[np.concatenate(found).astype(np.int64)]
        yield first[first != second], second[first != second]
    rays = cKDTree(centre)
    for face in large:
        near = np.array(rays.query_ball_point(centre[face], farthest + float(radius[face])), dtype=np.int64)
        near = near[near != face]
        yield near, np.full(len(near), face)


def _inside(points: np.ndarray, corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(N,) bool: whether points (N, 3) in the planes of triangles (N, 3, 3) lie in them, or on their edges."""
    found = np.ones(len(points), dtype=bool)
    size = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    for k in range(3):
        edge = corners[:, (k + 1) % 3] - corners[:, k]
        found &= (np.cross(edge, points - corners[:, k]) * normal).sum(axis=1) >= -1e-9 * size
    return found


def _smooth_groups(faces: np.ndarray, normal: np.ndarray, layer: np.ndarray) -> np.ndarray:
    """Labels (F,): faces of layers, and those of none, that hang together over edges which are not sharp."""
    first, second = topology.hinges(faces).faces.T
    joined = (layer[first] == layer[second]) & ((normal[first] * normal[second]).sum(axis=1) > _SHARP)
    ones = np.ones(int(joined.sum()), dtype=bool)
    graph = coo_matrix((ones, (first[joined], second[joined])), shape=(len(faces), len(faces)))
    return connected_components(graph, directed=False)[1]


def _widths(pos: np.ndarray, faces: np.ndarray, area: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Width (C,) of every group of faces: twice its area over the length around it."""
    hinges = topology.hinges(faces)
    one, other = label[hinges.faces].T
    length = np.linalg.norm(pos[hinges.vertices[:, 0]] - pos[hinges.vertices[:, 1]], axis=1) * (one != other)
    count = int(label.max()) + 1
    around = np.bincount(one, weights=length, minlength=count) + np.bincount(other, weights=length, minlength=count)
    return 2.0 * np.bincount(label, weights=area, minlength=count) / np.maximum(around, 1e-30)


def _unfolded(faces: np.ndarray, layer: np.ndarray, rim: np.ndarray, label: np.ndarray, opposite: np.ndarray) -> np.ndarray:
    """Labels (F,) with groups joined that meet in the edge of a fold, such as that of a cuff: both have their opposite layers
    elsewhere, where those that meet in a rim are each other's. Faces of a ``rim`` (F,) join nothing."""
    count = int(label.max()) + 1
    own, other = label[layer], label[opposite[layer]]
    facing, number = np.unique(own * count + other, return_counts=True)
    size = np.bincount(own, minlength=count)
    first, second = topology.hinges(faces).faces.T
    meet = ~rim[first] & ~rim[second] & (label[first] != label[second])
    pairs = np.unique(np.sort(np.stack([label[first[meet]], label[second[meet]]], axis=1), axis=1), axis=0)
    opposed = sum(_looked_up(facing, number, a * count + b) / np.maximum(size[a], 1) for a, b in (pairs.T, pairs.T[::-1]))
    folds = pairs[opposed < _FOLDED]
    graph = coo_matrix((np.ones(len(folds), bool), (folds[:, 0], folds[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1][label]


def _looked_up(keys: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Values (n,) of ascending keys; 0 where there is none."""
    place = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    return np.where(keys[place] == wanted, values[place], 0) if len(keys) else np.zeros(len(wanted))


def _grown(faces: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Sides (F,) with -1 only where both are around: what is left over is of the one side that it borders on."""
    first, second = topology.hinges(faces).faces.T
    left = side < 0
    joined = left[first] & left[second]
    graph = coo_matrix((np.ones(int(joined.sum()), bool), (first[joined], second[joined])), shape=(len(side), len(side)))
    label = connected_components(graph, directed=False)[1]
    beside = np.zeros((int(label.max()) + 1, 2), dtype=bool)
    for one, other in ((first, second), (second, first)):
        rows = left[one] & ~left[other]
        beside[label[one[rows]], side[other[rows]]] = True
    alone = beside.sum(axis=1) == 1
    return np.where(left & alone[label], beside[label].argmax(axis=1), side)


def _trimmed(pos: np.ndarray, faces: np.ndarray, normal: np.ndarray, rows: np.ndarray, thickness: float) -> np.ndarray:
    """Rows of a layer without what its rounded rim has left on it: narrow faces at its end, askew to their neighbours."""
    for _ in range(_TRIMS):
        half = faces[rows][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        _, back, times = np.unique(np.sort(half, axis=1) @ [len(pos), 1], return_inverse=True, return_counts=True)
        ends = (times[back] == 1).reshape(-1, 3)
        length = np.linalg.norm(pos[half[:, 1]] - pos[half[:, 0]], axis=1).reshape(-1, 3)
        area = _normals(pos, faces[rows])[1]
        height = 2.0 * area / length.max(axis=1).clip(1e-30)
        askew = ends.all(axis=1)
        first, second = topology.hinges(faces[rows]).faces.T
        apart = (normal[rows[first]] * normal[rows[second]]).sum(axis=1) < _SAME_PLANE
        askew[np.concatenate([first[apart], second[apart]])] = True
        gone = ends.any(axis=1) & askew & (height < _NARROW * thickness)
        if not gone.any():
            break
        rows = rows[~gone]
    return rows


def _matched(pos: np.ndarray, faces: np.ndarray, others: np.ndarray, farthest: float) -> np.ndarray | None:
    """(G, 3) the vertices of ``faces`` that lie nearest to those of ``others``; None where one is farther than that."""
    used = np.unique(faces)
    dist, nearest = cKDTree(pos[used]).query(pos[others.reshape(-1)])
    return None if dist.max(initial=0.0) > farthest else used[nearest].reshape(-1, 3)


def _in_order(faces: np.ndarray, others: np.ndarray) -> np.ndarray | None:
    """(G, 3) the vertices of ``faces`` of the same rank as those of ``others``: what a copy is written as."""
    used, theirs = np.unique(faces), np.unique(others)
    return used[np.searchsorted(theirs, others)] if len(used) == len(theirs) else None


def _keys(faces: np.ndarray, count: int) -> np.ndarray:
    """(F,) one number for the three vertices of a face, in any order."""
    assert count < 2**21
    return np.asarray(np.sort(faces, axis=1) @ np.array([count * count, count, 1], dtype=np.int64))
