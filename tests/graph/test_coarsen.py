"""Coarsening rules on graphs small enough to check by hand."""

import numpy as np
import pytest
from scipy.sparse import csgraph

from hood.graph import coarsen


def edges_of(graph) -> set[tuple[int, int]]:
    rows, cols = graph.nonzero()
    return {(int(a), int(b)) for a, b in zip(rows, cols, strict=True) if a < b}


def coarse_edges(num_nodes: int, edges: list[tuple[int, int]], root: int) -> set[tuple[int, int]]:
    return edges_of(coarsen.coarsen(coarsen.adjacency(num_nodes, np.array(edges)), np.array([root])))


def test_path_keeps_every_second_vertex():
    path = [(i, i + 1) for i in range(6)]
    assert coarse_edges(7, path, root=2) == {(0, 2), (2, 4), (4, 6)}


def test_odd_leaf_joins_its_inner_neighbours_only_if_they_are_far_apart():
    # Root 0; ring 1 = {1, 2, 3}; ring 2 = {4, 5, 6}; 7 is odd, without outer neighbours, below 4, 5 and 6.
    edges = [(0, 1), (0, 2), (0, 3), (1, 4), (2, 5), (3, 6), (4, 7), (5, 7), (6, 7)]
    # Rule 1 joins 4, 5, 6 to 0, so they are 2 hops apart and rule 2 adds nothing.
    assert coarse_edges(8, edges, root=0) == {(0, 4), (0, 5), (0, 6)}


def test_odd_leaf_closes_a_long_cycle():
    # A cycle of 10 from root 0: vertex 5 at distance 5 is an odd leaf whose inner neighbours 4 and 6 are 4 hops apart in (1).
    cycle = [(i, (i + 1) % 10) for i in range(10)]
    assert coarse_edges(10, cycle, root=0) == {(0, 2), (2, 4), (0, 8), (6, 8), (4, 6)}


def test_adjacent_even_vertices_join_if_they_are_far_apart():
    # A cycle of 9: the two far ends of the even ring, 4 and 5, are adjacent and 4 hops apart in (1).
    cycle = [(i, (i + 1) % 9) for i in range(9)]
    assert coarse_edges(9, cycle, root=0) == {(0, 2), (2, 4), (0, 7), (5, 7), (4, 5)}
    # A cycle of 5 closes through the root: 2 and 3 are 2 hops apart and are not joined.
    assert coarse_edges(5, [(i, (i + 1) % 5) for i in range(5)], root=0) == {(0, 2), (0, 3)}


def test_earlier_even_pairs_make_later_ones_superfluous():
    # Four arms of length 4 from root 0 end in 4, 8, 12, 16, which form a 4-cycle. 4 and 8 are joined first, then 4 and 16, 8
    # and 12; that brings 12 and 16 no closer than 3, so the cycle is complete; the chord 4–12 is 2 hops away by then.
    arms = [(0 if i % 4 == 1 else i - 1, i) for i in range(1, 17)]
    ring = [(4, 8), (8, 12), (12, 16), (4, 16), (4, 12)]
    joined = coarse_edges(17, arms + ring, root=0) & {(4, 8), (8, 12), (12, 16), (4, 16), (4, 12)}
    assert joined == {(4, 8), (4, 12), (4, 16)}


def test_unreached_vertices_play_no_role():
    assert coarse_edges(7, [(0, 1), (1, 2), (4, 5), (5, 6)], root=0) == {(0, 2)}


@pytest.mark.parametrize("seed", range(20))
def test_centre_is_exact(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 80))
    graph = coarsen.adjacency(count, rng.integers(0, count, (int(rng.integers(count, 2 * count)), 2)))
    hops = csgraph.shortest_path(graph, unweighted=True)
    eccentricity = np.where(np.isfinite(hops), hops, -1).max(axis=1)
    roots = coarsen.centres(graph)
    number, label = csgraph.connected_components(graph, directed=False)
    large = [c for c in range(number) if (label == c).sum() > 1]
    assert sorted(label[roots]) == large
    for root in roots:
        assert eccentricity[root] == eccentricity[label == label[root]].min()


def test_distances_from_a_root():
    graph = coarsen.adjacency(6, np.array([(0, 1), (1, 2), (2, 3), (0, 3)]))
    assert coarsen.distances(graph, 0).tolist() == [0, 1, 2, 1, -1, -1]
