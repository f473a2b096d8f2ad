"""Vertices of a mesh within a few edges of each other."""

from __future__ import annotations

import numpy as np
from scipy import sparse


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
