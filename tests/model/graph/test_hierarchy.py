"""Levels of whole meshes: published counts, nestedness, components, independence of file order."""

import numpy as np
import pytest
import torch
from scipy.sparse import csgraph

from hood.mesh.topology import unique_edges
from hood.model.graph import hierarchy
from hood.model.graph.hierarchy import build_hierarchy, concatenate_hierarchies, num_passed_over
from hood.testing import cylinder, grid, strip


def diagonal_grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges and positions of n × n vertices whose cells are all split along the same diagonal."""
    index = np.arange(n * n).reshape(n, n)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:]), (index[:-1, :-1], index[1:, 1:])]
    edges = np.concatenate([np.stack(pair, axis=-1).reshape(-1, 2) for pair in pairs])
    return edges, np.stack([*np.divmod(np.arange(n * n), n), np.zeros(n * n)], axis=1)


def levels(mesh, num_coarse=3):
    pos, faces = mesh
    return build_hierarchy(len(pos), unique_edges(faces), pos, num_coarse)


def as_set(edges: torch.Tensor) -> set[frozenset[int]]:
    return {frozenset(pair) for pair in edges.tolist()}


def test_counts_of_the_reference_grid():
    edges, pos = diagonal_grid(60)
    built = build_hierarchy(3600, edges, pos, 3)
    assert [len(torch.unique(e)) for e in built.coarse_edges] == [1770, 855, 456]
    assert [len(e) for e in built.coarse_edges] == [5017, 3766, 3143]


@pytest.mark.parametrize("mesh", [grid(30, 25), cylinder(24, 20), strip(60)])
def test_levels_are_nested_and_span_two_to_the_level(mesh):
    built = levels(mesh)
    hops = csgraph.shortest_path(hierarchy.adjacency(len(mesh[0]), unique_edges(mesh[1])), unweighted=True)
    inside = set(range(len(mesh[0])))
    for level, edges in enumerate(built.coarse_edges, start=1):
        nodes = set(edges.unique().tolist())
        assert nodes < inside
        assert hops[edges[:, 0], edges[:, 1]].max() <= 2**level
        assert torch.equal(built.node_level >= level, torch.isin(torch.arange(len(hops)), edges))
        assert csgraph.connected_components(hierarchy.adjacency(len(hops), edges.numpy()))[0] == len(hops) - len(nodes) + 1
        inside = nodes


@pytest.mark.parametrize("passed", [1, 2])
def test_levels_that_are_passed_over_are_those_between(passed):
    mesh = grid(30, 25)
    edges = unique_edges(mesh[1])
    found, whole = build_hierarchy(len(mesh[0]), edges, mesh[0], 2, passed), levels(mesh, 2 + passed)
    assert all(torch.equal(*pair) for pair in zip(found.coarse_edges, whole.coarse_edges[passed:], strict=True))
    assert torch.equal(found.node_level, (whole.node_level - passed).clamp_min(0))
    assert not build_hierarchy(len(mesh[0]), edges, mesh[0], 0, passed).coarse_edges


@pytest.mark.parametrize(
    "edge, coarse, passed",
    [(0.03, 0.04, 0), (0.02, 0.04, 0), (0.0199, 0.04, 1), (0.01, 0.04, 1), (0.005, 0.04, 2), (0.005, None, 0), (0.0, 0.04, 0)],
)
def test_coarse_edges_are_as_long_as_asked_for(edge, coarse, passed):
    assert num_passed_over(edge, coarse) == passed


def test_edges_are_listed_once_in_order():
    for edges in levels(grid(9, 7)).coarse_edges:
        assert (edges[:, 0] < edges[:, 1]).all()
        assert torch.equal(torch.unique(edges, dim=0), edges)


@pytest.mark.parametrize("seed", range(3))
def test_relabelled_mesh_gives_the_same_graph(seed):
    rng = np.random.default_rng(seed)
    pos, faces = cylinder(12, 9)
    pos = np.concatenate([pos, pos + 5.0])
    faces = np.concatenate([faces, faces + len(pos) // 2])
    order = rng.permutation(len(pos))  # new vertex i is old vertex order[i]
    relabelled = levels((pos[order], rng.permutation(np.argsort(order)[faces], axis=0)))
    built = levels((pos, faces))
    for new, old in zip(relabelled.coarse_edges, built.coarse_edges, strict=True):
        assert as_set(torch.as_tensor(order)[new]) == as_set(old)
    assert torch.equal(relabelled.node_level, built.node_level[order])


def test_components_do_not_touch_each_other():
    alone, other = levels(grid(7, 7)), levels(strip(12))
    pos, faces = grid(7, 7)
    far, strip_faces = strip(12)
    both = levels((np.concatenate([pos, far + 9.0]), np.concatenate([faces, strip_faces + 49])))
    for together, first, second in zip(both.coarse_edges, alone.coarse_edges, other.coarse_edges, strict=True):
        assert as_set(together) == as_set(first) | as_set(second + 49)


def test_tiny_and_isolated_vertices_stop_early():
    pos = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5.0]])
    built = build_hierarchy(4, np.array([[0, 1], [1, 2], [0, 2]]), pos, 3)
    assert [len(e) for e in built.coarse_edges] == [0, 0, 0]
    assert built.node_level.tolist() == [0, 0, 0, 0]
    none = build_hierarchy(1, np.zeros((0, 2)), pos[:1], 2)
    assert [tuple(e.shape) for e in none.coarse_edges] == [(0, 2), (0, 2)]
    assert none.node_level.tolist() == [0]


def test_batch_is_the_singles_shifted():
    meshes = [grid(7, 7), strip(12), strip(2)]
    singles = [levels(meshes[0]), levels(meshes[1], 1), levels(meshes[2], 2)]
    counts = [len(pos) for pos, _ in meshes]
    batch = concatenate_hierarchies(singles, counts)
    assert len(batch.coarse_edges) == 3
    start = 0
    for single, count in zip(singles, counts, strict=True):
        for k, edges in enumerate(batch.coarse_edges):
            own = edges[(edges[:, 0] >= start) & (edges[:, 0] < start + count)] - start
            expected = single.coarse_edges[k] if k < len(single.coarse_edges) else torch.zeros(0, 2, dtype=torch.int64)
            assert torch.equal(own, expected)
        assert torch.equal(batch.node_level[start : start + count], single.node_level)
        start += count


def test_bad_input_is_refused_by_name():
    pos = np.zeros((3, 3))
    with pytest.raises(ValueError, match="edge 1 is \\[1, 3\\]"):
        build_hierarchy(3, np.array([[0, 1], [1, 3]]), pos, 1)
    with pytest.raises(ValueError, match="rest_pos has shape"):
        build_hierarchy(4, np.array([[0, 1]]), pos, 1)
    pos[2, 1] = np.nan
    with pytest.raises(ValueError, match="vertex 2 is not finite"):
        build_hierarchy(3, np.array([[0, 1]]), pos, 1)
