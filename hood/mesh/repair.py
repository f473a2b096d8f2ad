"""Repairs of triangle meshes, each a function that says what it did; positions are never moved."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from hood.mesh import topology
from hood.mesh.quality import ZERO_AREA_RATIO

#: ``weld`` of "auto": vertices nearer than this share of the median edge are one.
WELD_RATIO = 1e-3


class Welded(NamedTuple):
    """``vertex_map`` (V,) leads from the old to the new vertices, ``kept`` (V',) from the new to the old."""

    vertex_map: np.ndarray
    kept: np.ndarray


def boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Vertices (n,) of edges that belong to exactly one face, ascending."""
    edges, counts = topology.counted_edges(faces)
    return np.unique(edges[counts == 1])


def weld_tolerance(pos: np.ndarray, faces: np.ndarray) -> float:
    """Distance [m] within which two vertices of a boundary are taken for one: a thousandth of the median edge."""
    edges = topology.unique_edges(faces)
    length = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    positive = length[length > 0]
    return WELD_RATIO * float(np.median(positive)) if len(positive) else 0.0


def weld(pos: np.ndarray, faces: np.ndarray, tolerance: float, left_out: np.ndarray | None = None) -> Welded:
    """Vertices on the boundary within ``tolerance`` [m] of each other become the first of them, but for some ``left_out`` (N,).

    Only boundary vertices: layers that touch (a pocket on a shirt) stay apart. Vertices that share a face are joined only
    where they coincide, or a tolerance beyond the edge length would eat the mesh. Chains count: a–b and b–c join a, b and c.
    """
    candidates = boundary_vertices(faces)
    candidates = candidates if left_out is None else np.setdiff1d(candidates, left_out)
    pairs = cKDTree(pos[candidates]).query_pairs(tolerance, output_type="ndarray") if len(candidates) else np.zeros((0, 2), int)
    pairs = candidates[pairs]
    edges = topology.unique_edges(faces)
    key = int(len(pos))
    joined = np.isin(np.sort(pairs, axis=1) @ [key, 1], edges @ [key, 1])
    apart = np.linalg.norm(pos[pairs[:, 0]] - pos[pairs[:, 1]], axis=1) > 0
    return merge(len(pos), pairs[~(joined & apart)])


def merge(num_vertices: int, pairs: np.ndarray) -> Welded:
    """Vertices connected by ``pairs`` (n, 2) become the one of the lowest number; the order is kept."""
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(num_vertices, num_vertices))
    _, label = connected_components(graph, directed=False)
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    kept = np.sort(first)
    return Welded(np.searchsorted(kept, first)[inverse.reshape(-1)], kept)


def sew_moving(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces (F', 3) of a moving mesh (T, W, 3) with doubled boundary vertices joined: the first of those that lie on each
    other in every frame stands for all. Vertices and their numbers stay; faces that lose a corner are left out.
    """
    tolerance = weld_tolerance(verts[0], faces)
    welded = weld(verts[0], faces, tolerance)
    first = welded.kept[welded.vertex_map]
    doubled = np.flatnonzero(first != np.arange(len(first)))
    # Lips that are closed in the first frame may open later. A chain of near pairs is a few tolerances long.
    apart = np.zeros(len(doubled))
    for frame in verts:
        apart = np.maximum(apart, np.linalg.norm(frame[doubled] - frame[first[doubled]], axis=1))
    opened = doubled[apart > 10.0 * tolerance]
    first[opened] = opened
    joined = first[faces]
    ordered = np.sort(joined, axis=1)
    return np.asarray(joined[(ordered[:, 1:] != ordered[:, :-1]).all(axis=1)])


def broken_faces(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces that repeat a vertex or have no area."""
    a, b, c = (pos[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest_sq = np.max([((x - y) ** 2).sum(axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    return area <= ZERO_AREA_RATIO * longest_sq


def duplicate_faces(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces with the vertices of an earlier one, in any order."""
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    repeated = np.ones(len(faces), dtype=bool)
    repeated[first] = False
    return repeated


def isolated_vertices(num_vertices: int, faces: np.ndarray) -> np.ndarray:
    """(V,) bool: vertices of no face."""
    alone = np.ones(num_vertices, dtype=bool)
    alone[faces.reshape(-1)] = False
    return alone


def flipped_faces(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces to turn over so that neighbours over an edge of two faces agree; the smaller part of each component.

    Where a component cannot be oriented (a Möbius strip) the faces reached last keep a disagreement.
    """
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(np.arange(len(faces)), 3)
    key = np.sort(half, axis=1) @ np.array([int(faces.max(initial=0)) + 1, 1])
    order = np.argsort(key, kind="stable")
    run_start = np.flatnonzero(np.r_[True, np.diff(key[order]) > 0])
    size = np.diff(np.r_[run_start, len(order)])
    first, second = order[run_start[size == 2]], order[run_start[size == 2] + 1]
    disagree = half[first, 0] == half[second, 0]
    return _two_colouring(len(faces), owner[first], owner[second], disagree)


def _two_colouring(count: int, a: np.ndarray, b: np.ndarray, differ: np.ndarray) -> np.ndarray:
    """(count,) bool with value(a) ^ value(b) = differ along breadth-first trees; the less frequent value is True."""
    value = np.where(differ, 2, 1)  # stored, not zero
    graph = coo_matrix((np.r_[value, value], (np.r_[a, b], np.r_[b, a])), shape=(count, count)).tocsr()
    number, label = connected_components(graph, directed=False)
    flipped = np.zeros(count, dtype=bool)
    if not differ.any():
        return flipped
    lookup = {(int(i), int(j)): bool(d) for i, j, d in zip(np.r_[a, b], np.r_[b, a], np.r_[differ, differ], strict=True)}
    _, first = np.unique(label, return_index=True)
    for component in np.unique(label[a[differ]]):
        nodes, parent = breadth_first_order(graph, int(first[component]), directed=False)
        for node in nodes[1:].tolist():
            flipped[node] = flipped[parent[node]] ^ lookup[(int(parent[node]), node)]
        members = label == component
        if flipped[members].sum() * 2 > members.sum():
            flipped[members] = ~flipped[members]
    assert number == len(first)
    return flipped
