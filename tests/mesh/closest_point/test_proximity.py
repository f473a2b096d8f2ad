import numpy as np
import pytest
import torch

from hood.mesh import topology
from hood.mesh.closest_point import search as proximity
from hood.mesh.closest_point import tree as surface_tree
from hood.mesh.closest_point.search import closest_point_on_triangles, search_surface
from hood.testing import assert_nearest, box, grid, sphere


@pytest.fixture(autouse=True, params=["compiled", "torch"])
def form(request, monkeypatch):
    """Every test runs with either form of the search."""
    if request.param == "torch":
        monkeypatch.setattr(surface_tree, "library", lambda: None)
    elif surface_tree.library() is None:
        pytest.skip("no C++ compiler")


def search(points, mesh, dtype=torch.float64):
    vertices, faces = torch.as_tensor(mesh[0]).to(dtype), torch.as_tensor(mesh[1])
    scene = [torch.zeros(n, dtype=torch.int64) for n in (len(points), len(vertices), len(faces))]
    return search_surface(torch.as_tensor(points).to(dtype), scene[0], vertices, faces, scene[1], scene[2])


def closest_points(hit, mesh):
    """Where the hits lie (N, 3)."""
    corners = torch.as_tensor(mesh[0])[torch.as_tensor(mesh[1])[hit.face]]
    return (hit.bary.unsqueeze(-1) * corners).sum(dim=1)


def brute_force(points, mesh):
    """Distance to the whole surface (N,), by minimising over faces, edges and vertices separately."""
    corners = mesh[0][mesh[1]]
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = points[:, None] - a[None]
    weights = np.linalg.solve(
        np.stack([np.stack([(u * u).sum(1), (u * v).sum(1)], 1), np.stack([(u * v).sum(1), (v * v).sum(1)], 1)], 1),
        np.stack([(p * u).sum(2), (p * v).sum(2)], 2)[..., None],
    )[..., 0]
    miss = np.linalg.norm(p - weights[..., :1] * u - weights[..., 1:] * v, axis=2)
    inside = (weights >= 0).all(axis=2) & (weights.sum(axis=2) <= 1)
    best = np.where(inside, miss, np.inf).min(axis=1)
    edges = topology.unique_edges(mesh[1])
    start, along = mesh[0][edges[:, 0]], mesh[0][edges[:, 1]] - mesh[0][edges[:, 0]]
    offset = points[:, None] - start[None]
    step = np.clip((offset * along).sum(2) / (along * along).sum(1), 0, 1)
    return np.minimum(best, np.linalg.norm(offset - step[..., None] * along, axis=2).min(axis=1))


def near_surface(rng, mesh, count, spread):
    corners = mesh[0][mesh[1][rng.integers(len(mesh[1]), size=count)]]
    weights = rng.dirichlet(np.ones(3), size=count)
    return np.einsum("nc,ncd->nd", weights, corners) + spread * rng.normal(size=(count, 3))


@pytest.mark.parametrize("mesh", [sphere(2), sphere(3), box(6)], ids=["sphere", "fine sphere", "box"])
def test_distances_equal_brute_force_and_signs_are_right(mesh):
    rng = np.random.default_rng(0)
    points = near_surface(rng, mesh, 400, 0.08)
    hit = search(points, mesh)
    expected = brute_force(points, mesh)
    np.testing.assert_allclose(hit.dist.abs().numpy(), expected, atol=1e-12)
    closest = closest_points(hit, mesh).numpy()
    np.testing.assert_allclose(np.linalg.norm(points - closest, axis=1), expected, atol=1e-12)


def spike(uneven):
    """A slender pyramid with acute edges everywhere, closed by a fan below."""
    angle = 2 * np.pi * np.linspace(0, 1, 9)[:-1] ** (3 if uneven else 1)
    ring = np.stack([0.15 * np.cos(angle), 0 * angle, -0.15 * np.sin(angle)], axis=1)
    pos = np.concatenate([ring, [[0.05, 1.0, 0.0], [0.05, 0.0, 0.0]]])
    k, following = np.arange(8), (np.arange(8) + 1) % 8
    sides = [np.stack([k, following, 0 * k + 8], 1), np.stack([following, k, 0 * k + 9], 1)]
    return pos, np.concatenate(sides)


@pytest.mark.parametrize("uneven", [False, True])
def test_sign_and_distance_around_acute_edges_and_uneven_fans(uneven):
    """Face normals alone, or unweighted sums of them, give wrong signs here."""
    mesh = spike(uneven)
    rng = np.random.default_rng(6)
    points = np.concatenate([near_surface(rng, mesh, 2000, 0.1), mesh[0][8] + 0.2 * rng.normal(size=(2000, 3))])
    corners = mesh[0][mesh[1]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inside = (np.einsum("nfd,fd->nf", points[:, None] - corners[None, :, 0], normals) < 0).all(axis=1)
    assert inside.sum() > 50
    hit = search(points, mesh)
    np.testing.assert_array_equal(hit.dist.numpy() < 0, inside)
    np.testing.assert_allclose(hit.dist.abs().numpy(), brute_force(points, mesh), atol=1e-12)


@pytest.mark.parametrize("spread", [0.02, 0.5])
def test_sign_around_a_box_with_sharp_edges(spread):
    mesh = box(6)
    points = near_surface(np.random.default_rng(1), mesh, 1000, spread)
    inside = (np.abs(points) < 0.5).all(axis=1)
    assert 100 < inside.sum() < 900
    np.testing.assert_array_equal(search(points, mesh).dist.numpy() < 0, inside)
    near = np.abs(search(points, mesh).dist.numpy()) > 1e-5
    single = search(points, mesh, torch.float32)
    np.testing.assert_array_equal((single.dist.numpy() < 0)[near], inside[near])


def test_triangle_soup_of_a_few_faces_is_searched_exhaustively():
    rng = np.random.default_rng(7)
    mesh = (rng.normal(size=(120, 3)), np.arange(120).reshape(40, 3))
    points = 2 * rng.normal(size=(500, 3))
    np.testing.assert_allclose(search(points, mesh).dist.abs().numpy(), brute_force(points, mesh), atol=1e-12)


def test_pseudonormal_of_a_corner_does_not_depend_on_the_diagonals():
    """Sides of a cube meet a corner with one face or two: weighted by angles, the normal is the diagonal."""
    vertices, faces = (torch.as_tensor(x) for x in box(3))
    incidence = proximity.build_incidence(faces, len(vertices))
    corners = (vertices.abs() > 0.49).all(dim=1).nonzero().squeeze(1)
    fans = proximity.build_fans(vertices * torch.tensor([1.0, 2.0, 1.0], dtype=vertices.dtype), incidence)
    normals = proximity._vertex_pseudonormals(corners, incidence, fans)
    expected = np.pi / 2 * vertices[corners].sign()
    assert len(corners) == 8
    torch.testing.assert_close(normals, expected)


def test_sign_at_a_reentrant_edge():
    """Two sheets that meet in a valley: above it is outside although each sheet ends there."""
    vertices = np.array([[0, 0, -1], [0, 0, 1], [-1, 1, 0], [1, 1, 0.0]])
    faces = np.array([[0, 1, 3], [1, 0, 2]])
    hit = search(np.array([[0, 0.2, 0], [0, -0.2, 0], [0.3, -0.1, 0], [-0.3, -0.1, 0]]), (vertices, faces))
    assert (hit.dist > 0).tolist() == [True, False, False, False]


def test_nearest_vertex_and_distance():
    mesh = sphere(2)
    points = near_surface(np.random.default_rng(2), mesh, 200, 0.1)
    hit = search(points, mesh)
    assert_nearest(torch.as_tensor(points), torch.as_tensor(mesh[0]), hit.vertex)
    expected = np.linalg.norm(points - mesh[0][hit.vertex.numpy()], axis=1)
    np.testing.assert_allclose(hit.vertex_dist.numpy(), expected, rtol=1e-12)


def test_scenes_see_only_their_own_surface():
    small, large = sphere(2, 0.5), box(6, 2.0)
    rng = np.random.default_rng(3)
    points = [near_surface(rng, mesh, 100, 0.1) for mesh in (small, large)]
    alone = [search(p, mesh) for p, mesh in zip(points, (small, large), strict=True)]
    # Points interleaved, surfaces stacked: nothing relies on the order of the points.
    order = torch.as_tensor(rng.permutation(200))
    scene = torch.arange(2).repeat_interleave(100)
    vertices = torch.as_tensor(np.concatenate([small[0], large[0]]))
    faces = torch.as_tensor(np.concatenate([small[1], large[1] + len(small[0])]))
    counts = (
        torch.tensor([len(mesh[0]) for mesh in (small, large)]),
        torch.tensor([len(m[1]) for m in (small, large)]),
    )
    vertex_scene, face_scene = (torch.arange(2).repeat_interleave(count) for count in counts)
    hit = search_surface(
        torch.as_tensor(np.concatenate(points))[order],
        scene[order],
        vertices,
        faces,
        vertex_scene,
        face_scene,
    )
    torch.testing.assert_close(hit.dist, torch.cat([a.dist for a in alone])[order], rtol=0, atol=1e-14)
    # Faces that share the nearest edge or corner are equally near: the point is unique, not the face.
    expected = torch.cat([closest_points(*both) for both in zip(alone, (small, large), strict=True)])
    torch.testing.assert_close(closest_points(hit, (vertices, faces)), expected[order], rtol=0, atol=1e-12)
    assert torch.equal(face_scene[hit.face], scene[order])


def test_oversized_faces_are_found_next_to_fine_ones():
    """A sphere above a floor of two triangles: vertices of the floor are far from every point."""
    body = sphere(3, 0.2)
    floor = np.array([[-10, -1, -10], [-10, -1, 10], [10, -1, 10], [10, -1, -10.0]])
    mesh = (
        np.concatenate([body[0], floor]),
        np.concatenate([body[1], np.array([[0, 1, 2], [0, 2, 3]]) + len(body[0])]),
    )
    hit = search(np.array([[0.5, -0.95, 0.5], [3.0, -1.2, 1.0], [0.0, 0.25, 0.0]]), mesh)
    np.testing.assert_allclose(hit.dist.numpy(), [0.05, -0.2, 0.05], atol=1e-3)


def test_dense_search_of_accelerators_equals_the_tree():
    rng = np.random.default_rng(4)
    mesh = sphere(2)
    points, vertices = torch.as_tensor(near_surface(rng, mesh, 50, 0.1)), torch.as_tensor(mesh[0])
    tree, dense = proximity._search_tree(points, vertices), proximity._search_dense(points, vertices)
    torch.testing.assert_close(tree[0], dense[0])
    torch.testing.assert_close(tree[1], dense[1], rtol=1e-12, atol=0)


def test_scene_without_surface_and_undefined_points_match_nothing():
    mesh = grid(4, 4)
    vertices, faces = torch.as_tensor(mesh[0]), torch.as_tensor(mesh[1])
    points = torch.tensor([[0.5, 0.1, 0.5], [0.5, 0.1, 0.5], [float("nan"), 0.0, 0.0]], dtype=torch.float64)
    zeros = [torch.zeros(n, dtype=torch.int64) for n in (len(vertices), len(faces))]
    hit = search_surface(points, torch.tensor([0, 1, 0]), vertices, faces, *zeros)
    assert float(hit.dist[0]) == pytest.approx(0.1)
    assert torch.isinf(hit.dist[1])
    assert not bool(hit.dist[2].abs() <= 1e9)


def test_vertices_without_faces_are_ignored():
    mesh = sphere(2)
    vertices = np.concatenate([mesh[0], [[2.0, 0, 0]] * 3])
    hit = search(np.array([[1.9, 0.0, 0.0]]), (vertices, mesh[1]))
    assert int(hit.vertex) < len(mesh[0])
    assert float(hit.dist) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("num_used", [1, 2])
def test_batched_surfaces_of_fewer_than_three_vertices(num_used):
    """Faces that use one or two vertices are a point or an edge; the other scene of the batch is a sphere."""
    ball = sphere(2)
    vertices = torch.as_tensor(np.concatenate([ball[0], [[0.0, 0, 0], [1.0, 0, 0]]]))
    degenerate = len(ball[0]) + np.array([[0, 0, 0], [0, 0, num_used - 1]])
    faces = torch.as_tensor(np.concatenate([ball[1], degenerate]))
    vertex_scene = (torch.arange(len(vertices)) >= len(ball[0])).long()
    face_scene = (torch.arange(len(faces)) >= len(ball[1])).long()
    points = torch.tensor([[2.0, 0, 0], [2.0, 0, 0], [0.5, 0.3, 0]], dtype=torch.float64)
    hit = search_surface(points, torch.tensor([0, 1, 1]), vertices, faces, vertex_scene, face_scene)
    expected = [1.0, 2.0, 0.34**0.5] if num_used == 1 else [1.0, 1.0, 0.3]
    np.testing.assert_allclose(hit.dist.abs().numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(hit.vertex_dist.numpy(), [1.0, float(num_used == 1) + 1, 0.34**0.5], atol=1e-12)
    assert hit.vertex.tolist()[1] == len(ball[0]) + num_used - 1


def test_incidence_is_recognised_without_reading_it_and_by_content(monkeypatch):
    faces = torch.as_tensor(sphere(1)[1])
    first = proximity.build_incidence(faces, 42)
    assert proximity.build_incidence(faces.clone(), 42) is first
    with monkeypatch.context() as patch:
        patch.setattr(torch, "equal", None)
        assert proximity.build_incidence(faces, 42) is first
    with torch.inference_mode():
        assert proximity.build_incidence(faces.clone(), 42) is first
    faces[0] = faces[0].flip(0)
    assert proximity.build_incidence(faces, 42) is not first


def test_closest_point_on_triangles_is_a_minimum():
    rng = np.random.default_rng(5)
    corners = torch.as_tensor(rng.normal(size=(300, 3, 3)))
    points = torch.as_tensor(2 * rng.normal(size=(300, 3)))
    bary = closest_point_on_triangles(points, corners)
    assert (bary >= 0).all()
    torch.testing.assert_close(bary.sum(dim=1), torch.ones(300, dtype=torch.float64))
    dist = ((bary.unsqueeze(-1) * corners).sum(dim=1) - points).norm(dim=1)
    samples = torch.as_tensor(rng.dirichlet(np.ones(3) * 0.5, size=2000))
    sampled = (torch.einsum("sc,ncd->nsd", samples, corners) - points.unsqueeze(1)).norm(dim=2).min(dim=1).values
    assert (dist <= sampled + 1e-12).all()
    assert float((sampled - dist).max()) < 0.2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_closest_point_on_degenerate_triangles(dtype):
    corners = torch.tensor([[[0, 0, 0]] * 3, [[0, 0, 0], [1, 0, 0], [3, 0, 0]], [[0, 0, 0], [0, 0, 0], [2, 0, 0]]], dtype=dtype)
    points = torch.tensor([[1, 2, 2], [2, 1, 0], [1, 0, 1]], dtype=dtype)
    bary = closest_point_on_triangles(points, corners)
    dist = ((bary.unsqueeze(-1) * corners).sum(dim=1) - points).norm(dim=1)
    torch.testing.assert_close(dist, torch.tensor([3.0, 1.0, 1.0], dtype=dtype))
