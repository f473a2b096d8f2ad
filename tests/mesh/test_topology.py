import numpy as np

from hood.mesh import topology
from hood.testing import cylinder, grid, sphere


def test_closed_sphere_satisfies_euler_and_has_a_hinge_per_edge():
    pos, faces = sphere(2)
    edges, hinges = topology.unique_edges(faces), topology.hinges(faces)
    assert len(pos) - len(edges) + len(faces) == 2
    np.testing.assert_array_equal(hinges.vertices[:, :2], edges)
    assert topology.boundary_loops(faces) == []


def test_edges_are_ascending_unique_and_sorted():
    edges = topology.unique_edges(np.array([[3, 1, 0], [3, 2, 1]]))
    np.testing.assert_array_equal(edges, [[0, 1], [0, 3], [1, 2], [1, 3], [2, 3]])
    assert edges.dtype == np.int64


def test_edges_are_counted_by_their_faces():
    edges, counts = topology.counted_edges(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    np.testing.assert_array_equal(edges, [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [1, 3], [1, 4]])
    np.testing.assert_array_equal(counts, [3, 1, 1, 1, 1, 1, 1])
    none, number = topology.counted_edges(np.zeros((0, 3), dtype=np.int64))
    assert (none.shape, number.shape) == ((0, 2), (0,))


def test_hinge_names_edge_and_opposite_vertices():
    hinges = topology.hinges(np.array([[3, 1, 0], [3, 2, 1]]))
    np.testing.assert_array_equal(hinges.vertices, [[1, 3, 0, 2]])
    np.testing.assert_array_equal(hinges.faces, [[0, 1]])


def test_hinges_do_not_depend_on_winding():
    _, faces = grid(5, 4)
    flipped = faces.copy()
    flipped[::3] = flipped[::3, ::-1]
    np.testing.assert_array_equal(topology.hinges(flipped).vertices, topology.hinges(faces).vertices)


def test_edge_with_four_faces_gives_a_chain_of_three_hinges():
    fin = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 1, 5]])
    hinges = topology.hinges(fin)
    np.testing.assert_array_equal(hinges.faces, [[0, 1], [1, 2], [2, 3]])
    np.testing.assert_array_equal(hinges.vertices, [[0, 1, 2, 3], [0, 1, 3, 4], [0, 1, 4, 5]])


def test_hinge_vertices_belong_to_their_faces():
    _, faces = cylinder(7, 4)
    hinges = topology.hinges(faces)
    for vertices, (first, second) in zip(hinges.vertices, hinges.faces, strict=True):
        assert set(faces[first]) == {*vertices[:2], vertices[2]}
        assert set(faces[second]) == {*vertices[:2], vertices[3]}


def test_components_are_numbered_by_smallest_vertex():
    labels = topology.connected_components(6, np.array([[4, 5], [1, 3]]))
    np.testing.assert_array_equal(labels, [0, 1, 2, 1, 3, 3])
    np.testing.assert_array_equal(topology.connected_components(2, np.zeros((0, 2))), [0, 1])


def test_boundary_of_a_grid_is_its_rim():
    n, m = 5, 4
    _, faces = grid(n, m)
    (loop,) = topology.boundary_loops(faces)
    rim = {v for v in range(n * m) if v // m in (0, n - 1) or v % m in (0, m - 1)}
    assert set(loop.tolist()) == rim
    assert len(loop) == len(rim)
    edges = {tuple(edge) for edge in topology.unique_edges(faces).tolist()}
    assert all(tuple(sorted(pair)) in edges for pair in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))


def test_boundary_of_a_tube_is_two_rings():
    loops = topology.boundary_loops(cylinder(7, 4)[1])
    assert [sorted(loop.tolist()) for loop in loops] == [list(range(7)), list(range(21, 28))]


def test_boundary_loops_that_touch_use_every_edge_once():
    bow_tie = np.array([[0, 1, 2], [0, 3, 4]])
    loops = topology.boundary_loops(bow_tie)
    assert sorted(len(loop) for loop in loops) == [3, 3]


def test_empty_mesh_has_no_topology():
    none = np.zeros((0, 3), dtype=np.int64)
    assert topology.unique_edges(none).shape == (0, 2)
    assert topology.hinges(none).vertices.shape == (0, 4)
    assert topology.boundary_loops(none) == []


def test_edge_index_finds_edges_in_any_direction():
    edges = topology.unique_edges(grid(4, 3)[1])
    order = np.random.default_rng(0).permutation(len(edges))
    np.testing.assert_array_equal(topology.edge_index(edges, edges[order][:, ::-1]), order)
