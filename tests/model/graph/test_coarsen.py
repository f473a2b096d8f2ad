"""Coarsening rules on graphs small enough to check by hand."""

import numpy as np
import pytest
from scipy.sparse import csgraph
from scipy.spatial import Delaunay

from hood.assets.files.library import names
from hood.assets.garment.garment import load_garment
from hood.mesh.topology import unique_edges
from hood.model.graph import hierarchy
from hood.testing import cylinder


def edges_of(graph) -> set[tuple[int, int]]:
    rows, cols = graph.nonzero()
    return {(int(a), int(b)) for a, b in zip(rows, cols, strict=True) if a < b}


def coarse_edges(num_nodes: int, edges: list[tuple[int, int]], root: int) -> set[tuple[int, int]]:
    return edges_of(hierarchy.coarsen(hierarchy.adjacency(num_nodes, np.array(edges)), np.array([root])))


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
    graph = hierarchy.adjacency(count, rng.integers(0, count, (int(rng.integers(count, 2 * count)), 2)))
    hops = csgraph.shortest_path(graph, unweighted=True)
    eccentricity = np.where(np.isfinite(hops), hops, -1).max(axis=1)
    roots = hierarchy.centres(graph)
    number, label = csgraph.connected_components(graph, directed=False)
    large = [c for c in range(number) if (label == c).sum() > 1]
    assert sorted(label[roots]) == large
    for root in roots:
        assert eccentricity[root] == eccentricity[label == label[root]].min()


def test_distances_from_a_root():
    graph = hierarchy.adjacency(6, np.array([(0, 1), (1, 2), (2, 3), (0, 3)]))
    assert hierarchy.distances(graph, 0).tolist() == [0, 1, 2, 1, -1, -1]


# ---- the rules once more, naively: sets and breadth-first searches, no matrices ------------------------------------------


def naive_graph(graph) -> list[set[int]]:
    return [set(graph.indices[graph.indptr[a] : graph.indptr[a + 1]].tolist()) for a in range(graph.shape[0])]


def naive_distances(near: list[set[int]], roots: list[int], limit: int | None = None) -> dict[int, int]:
    """Hops from the nearest of ``roots`` to everything within ``limit`` hops."""
    dist, front = dict.fromkeys(roots, 0), list(roots)
    while front and (limit is None or dist[front[0]] < limit):
        reached = {b for a in front for b in near[a]} - dist.keys()
        dist |= dict.fromkeys(reached, dist[front[0]] + 1)
        front = sorted(reached)
    return dist


def is_far(near: list[set[int]], a: int, b: int) -> bool:
    return b not in naive_distances(near, [a], limit=2)


def join(graph: list[set[int]], a: int, b: int) -> None:
    graph[a].add(b)
    graph[b].add(a)


def naive_coarsen(near: list[set[int]], roots: list[int]) -> list[set[int]]:
    """The three rules in their order, pair by pair."""
    dist = naive_distances(near, roots)
    odd = sorted(a for a, d in dist.items() if d % 2 == 1)
    inner, outer = ({a: sorted(b for b in near[a] if dist[b] == dist[a] + side) for a in odd} for side in (-1, 1))
    level: list[set[int]] = [set() for _ in near]
    for a, b in ((a, b) for k in odd for a in inner[k] for b in outer[k]):
        join(level, a, b)
    leaves = [inner[k] for k in odd if not outer[k]]
    for a, b in [(a, b) for ring in leaves for a in ring for b in ring if a < b and is_far(level, a, b)]:
        join(level, a, b)
    even = sorted((a, b) for a in dist for b in near[a] if a < b and dist[a] == dist[b] and dist[a] % 2 == 0)
    for a, b in even:
        if is_far(level, a, b):
            join(level, a, b)
    return level


def assert_levels_follow_the_rules(num_vertices: int, edges: np.ndarray, num_levels: int = 3) -> None:
    graph = hierarchy.adjacency(num_vertices, edges)
    roots = hierarchy.centres(graph)
    for _ in range(num_levels):
        expected = naive_coarsen(naive_graph(graph), roots.tolist())
        graph = hierarchy.coarsen(graph, roots)
        assert (graph != graph.T).nnz == 0
        assert naive_graph(graph) == expected


def by_rest_position(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Edges in the numbers that :func:`hood.model.graph.hierarchy.build_hierarchy` gives the vertices."""
    rank = np.empty(len(pos), dtype=np.int64)
    rank[np.lexsort(pos.T[::-1])] = np.arange(len(pos))
    return rank[unique_edges(faces)]


@pytest.mark.parametrize("name", names("garments"))
def test_levels_of_the_default_garments_follow_the_rules(name):
    garment = load_garment(name)
    assert_levels_follow_the_rules(len(garment.rest_pos), by_rest_position(garment.rest_pos, garment.faces))


def random_mesh(seed: int) -> tuple[int, np.ndarray]:
    """A triangulated cloud, a tube with holes, or triangles without any order; numbered at random."""
    rng = np.random.default_rng(seed)
    if seed % 3 == 0:
        count = int(rng.integers(4, 80))
        faces = Delaunay(rng.random((count, 2)) * [1.0, rng.uniform(0.1, 1.0)]).simplices
    elif seed % 3 == 1:
        pos, faces = cylinder(int(rng.integers(3, 12)), int(rng.integers(2, 8)))
        count, faces = len(pos), faces[rng.random(len(faces)) < 0.9]
    else:
        count = int(rng.integers(4, 60))
        faces = np.stack([rng.permutation(count)[:3] for _ in range(int(rng.integers(2, count)))])
    return count, rng.permutation(count)[unique_edges(faces)]


def test_levels_of_random_meshes_follow_the_rules():
    for seed in range(200):
        assert_levels_follow_the_rules(*random_mesh(seed))
