"""The hems of a garment in pictures: how far its vertices are from them, and the lines along them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from hood.mesh.topology import counted_edges

Array = NDArray[np.float64]

#: Distance [m] that stands for no hem near by.
FAR = 1.0
#: Distances of at least this [m] do not matter: the seam is nearer.
_REACH = 0.08
_SAMPLES = 8  # points of every boundary edge

_EDGE_WIDTH, _EDGE_SHADE = 0.0025, 0.3  # m, share of the colour taken
_SEAM_AT, _SEAM_HALF_WIDTH, _SEAM_SHADE = 0.02, 0.0015, 0.35


def hem_distance(pos: ArrayLike, faces: ArrayLike) -> Array:
    """Distance [m] of every vertex from the next open edge of its surface, (V,); :data:`FAR` where none is near.

    Near is what is near along the surface: a sleeve beside the waist is not.

    Args:
        pos: (V, 3) [m], at rest.
        faces: (F, 3).
    """
    points, corners = np.asarray(pos, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    edges, count = counted_edges(corners)
    open_edges = edges[count == 1]
    result = np.full(len(points), FAR)
    if not len(open_edges) or not np.isfinite(points).all():
        return result
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    graph = coo_matrix((np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), shape=2 * (len(points),))
    along = dijkstra(graph, directed=False, indices=np.unique(open_edges), min_only=True, limit=_REACH)
    share = np.linspace(0.0, 1.0, _SAMPLES)[:, None, None]
    start, end = points[open_edges[:, 0]], points[open_edges[:, 1]]
    dist, _ = cKDTree((start + share * (end - start)).reshape(-1, 3)).query(points)
    near = np.isfinite(along)
    result[near] = dist[near]
    return result


def sewn(dist: Array, foot: Array) -> Array:
    """Share (P,) of a colour that is left by the edge of a hem and by its seam, 2 cm from it.

    Args:
        dist: (P,) distance from the hem [m].
        foot: (P,) side of a pixel there [m], over which lines are smoothed.
    """
    edge = np.clip((_EDGE_WIDTH - dist) / foot + 0.5, 0.0, 1.0)
    seam = np.clip((_SEAM_HALF_WIDTH - np.abs(dist - _SEAM_AT)) / foot + 0.5, 0.0, 1.0)
    seam *= np.minimum(1.0, 2.0 * _SEAM_HALF_WIDTH / foot)
    left: Array = 1.0 - _EDGE_SHADE * edge - _SEAM_SHADE * seam
    return left
