"""Connectivity of triangle meshes: edges, hinges (pairs of faces over an edge), components, boundary loops.

Everything here is index arithmetic on numpy int64 arrays; no positions are involved.

Vertices of a mesh within a few edges of each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components as _sparse_components


class Rings:
    """The vertices within ``count`` edges of each vertex, itself included; ``edges`` (E, 2) undirected."""

    def __init__(self, num_vertices: int, edges: np.ndarray, count: int = 2) -> None:
        self._num = num_vertices
        ones = np.ones(len(edges), dtype=np.int32)
        beside = sparse.coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(num_vertices, num_vertices)).tocsr()
        ring = reached = beside + beside.T + sparse.identity(num_vertices, dtype=np.int32, format="csr")
        for _ in range(count - 1):
            reached = reached @ ring
            reached.data[:] = 1  # paths are not counted, or their number would grow beyond what is held
        table = reached.tocoo()
        self._keys = np.sort(table.row.astype(np.int64) * num_vertices + table.col)

    def hold(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Whether each of two arrays of vertices is within the rings of the other."""
        keys = first * self._num + second
        if not len(self._keys):
            return np.zeros(keys.shape, dtype=bool)
        place = np.searchsorted(self._keys, keys).clip(max=len(self._keys) - 1)
        return np.asarray(self._keys[place] == keys)


class Hinges(NamedTuple):
    """Pairs of faces that share an edge.

    ``vertices`` (H, 4): edge start, edge end, opposite vertex of face 0, opposite vertex of face 1.
    ``faces`` (H, 2): the two faces. The edge start is the smaller index, face 0 comes before face 1.
    """

    vertices: np.ndarray
    faces: np.ndarray


def unique_edges(faces: np.ndarray) -> np.ndarray:
    """Undirected edges (E, 2) of ``faces`` (F, 3): each row ascending, rows in lexicographic order."""
    return counted_edges(faces)[0]


def counted_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of :func:`unique_edges`, and how many faces (E,) each belongs to: 1 on the boundary."""
    edges = np.sort(_half_edges(faces)[:, :2], axis=1)
    key = int(edges.max(initial=0)) + 1  # one number an edge: sorted much faster than rows
    # With counts numpy sorts; without them it hashes, which takes ten times as long.
    found, counts = np.unique(edges @ np.array([key, 1], dtype=np.int64), return_counts=True)
    return np.stack(np.divmod(found, key), axis=1), counts


def edge_index(edges: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Rows (N,) of ``edges`` (E, 2), as :func:`unique_edges` orders them, that hold the vertex pairs (N, 2); any direction."""
    pairs = np.sort(np.asarray(pairs, dtype=np.int64).reshape(-1, 2), axis=1)
    key = np.array([int(edges.max(initial=0)) + 1, 1])
    return np.searchsorted(edges @ key, pairs @ key)


def hinges(faces: np.ndarray) -> Hinges:
    """Hinges of ``faces`` (F, 3), ordered by edge; the winding of the faces plays no role.

    An edge with n faces yields n - 1 hinges: its faces in ascending order, each paired with the next. Two
    faces give the usual hinge, a boundary edge none, and a non-manifold edge (3+ faces, a sewn-in pocket) a
    chain, so that every face at it is held.
    """
    half = _half_edges(faces)
    edges = np.sort(half[:, :2], axis=1)
    owner = np.tile(np.arange(len(half) // 3, dtype=np.int64), 3)
    order = np.lexsort((owner, edges[:, 1], edges[:, 0]))
    edges, opposite, owner = edges[order], half[order, 2], owner[order]
    same = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    vertices = np.column_stack([edges[same], opposite[same], opposite[same + 1]])
    return Hinges(vertices, np.column_stack([owner[same], owner[same + 1]]))


def connected_components(num_vertices: int, edges: np.ndarray) -> np.ndarray:
    """Component label (V,) of every vertex, int64, numbered by the smallest vertex of each component.

    Vertices without edges are components of their own.
    """
    pairs = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    ones = np.ones(len(pairs), dtype=bool)
    graph = coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(num_vertices, num_vertices))
    _, labels = _sparse_components(graph, directed=False)
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed loops of edges that belong to exactly one face, as vertex arrays, longest first (ties: smallest
    vertex).

    A loop starts at its smallest vertex and walks on to the smaller of that vertex's unused neighbours. Where
    loops touch in a vertex the walk takes the smallest unused neighbour. A closed surface has none.
    """
    edges, counts = counted_edges(faces)
    neighbours: dict[int, list[int]] = {}
    for a, b in edges[counts == 1].tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    loops = [_walk(neighbours, start) for start in sorted(neighbours) if neighbours[start]]
    # A vertex where loops touch may start again with edges left over.
    while remaining := [vertex for vertex in sorted(neighbours) if neighbours[vertex]]:
        loops.append(_walk(neighbours, remaining[0]))
    loops = [loop for loop in loops if len(loop)]
    return sorted(loops, key=lambda loop: (-len(loop), int(loop[0])))


def _walk(neighbours: dict[int, list[int]], start: int) -> np.ndarray:
    """Follow unused boundary edges from ``start`` until it is reached again; uses them up."""
    loop, vertex = [], start
    while neighbours[vertex]:
        loop.append(vertex)
        following = min(neighbours[vertex])
        neighbours[vertex].remove(following)
        neighbours[following].remove(vertex)
        vertex = following
        if vertex == start:
            break
    return np.asarray(loop, dtype=np.int64)


def _half_edges(faces: np.ndarray) -> np.ndarray:
    """(3F, 3): start, end, opposite vertex; first all edges 0-1, then all 1-2, then all 2-0."""
    faces = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    return np.concatenate([faces, faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
