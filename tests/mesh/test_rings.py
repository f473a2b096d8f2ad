"""Vertices few edges apart."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import shortest_path

from hood.mesh.topology import Rings, unique_edges
from hood.testing import grid


@pytest.mark.parametrize("count", [1, 2, 3])
def test_rings_are_those_of_the_shortest_paths(count: int) -> None:
    pos, faces = grid(7, 5, 0.3)
    edges = unique_edges(faces)
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(pos), len(pos)))
    hops = shortest_path(graph, directed=False, unweighted=True)
    first, second = (table.ravel() for table in np.indices(hops.shape))
    np.testing.assert_array_equal(Rings(len(pos), edges, count).hold(first, second), hops.ravel() <= count)


def test_vertices_without_edges_have_themselves_alone() -> None:
    rings = Rings(3, np.zeros((0, 2), dtype=np.int64))
    assert rings.hold(np.array([0, 0]), np.array([0, 1])).tolist() == [True, False]
