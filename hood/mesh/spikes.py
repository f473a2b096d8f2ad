"""Vertices that stand out of a mesh like thorns, as a slip of the hand or a damaged file leaves them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hood.mesh.topology import unique_edges

#: A thorn is at least so many times as long as the edges around it, and as the ring of its neighbours is wide. A mesh whose
#: edges become longer has 2 at most, the tip of a cap or a hood is as far from its ring as that is wide. The tip of a fan of
#: more triangles than these is a hat up to another multiple.
_LONGER, _FAN, _HAT = 3.5, 12, 5.0


class Spikes(NamedTuple):
    """Vertices that stand out."""

    vertices: np.ndarray  # (n,) ascending
    height: np.ndarray  # (n,) to the nearest neighbour, in the mesh's unit
    ratio: np.ndarray  # (n,) of that to the middle length of the edges around


def find_spikes(pos: np.ndarray, faces: np.ndarray, least: float) -> Spikes:
    """Vertices of the mesh ``pos`` (V, 3), ``faces`` (F, 3) at least ``least`` from all neighbours, in the mesh's unit, and far
    beside the edges of those."""
    edges = unique_edges(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    starts = np.searchsorted(both[:, 0], np.arange(len(pos) + 1))
    length = np.linalg.norm(pos[both[:, 1]] - pos[both[:, 0]], axis=1)
    nearest = np.full(len(pos), np.inf)
    np.minimum.at(nearest, both[:, 0], length)
    found = []
    for vertex in np.flatnonzero((nearest >= least) & (nearest < np.inf)):
        ring = both[starts[vertex] : starts[vertex + 1], 1]
        rows = np.concatenate([np.arange(starts[other], starts[other + 1]) for other in ring])
        around = np.median(length[rows[both[rows, 1] != vertex]])
        wide = np.linalg.norm(pos[ring] - pos[ring].mean(axis=0), axis=1).max()
        if nearest[vertex] >= max(_LONGER * around, (_HAT if len(ring) > _FAN else _LONGER) * wide):
            found.append((vertex, nearest[vertex] / around))
    vertices = np.array([vertex for vertex, _ in found], dtype=np.int64)
    return Spikes(vertices, nearest[vertices], np.array([ratio for _, ratio in found]))
