"""Nearest vertices: both forms against all pairs in float64, and the dense form free of anything the host must wait for."""

from __future__ import annotations

import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, DynamicOutputShapeException, FakeTensorMode

from hood.mesh.closest_point import vertices as nearest
from hood.mesh.closest_point.vertices import nearest_dense, nearest_vertices

FORMS = [nearest_vertices, nearest_dense]


def cloud(count: int, seed: int, num_scenes: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return points.float(), torch.randint(num_scenes, (count,), generator=generator)


def expected(points, point_scene, vertices, vertex_scene, usable, radius):
    pairs = (points.double()[:, None] - vertices.double()[None]).norm(dim=2)
    pairs[point_scene[:, None] != vertex_scene[None]] = torch.inf
    pairs[:, ~usable] = torch.inf
    dist, index = pairs.min(dim=1)
    return torch.where(dist < radius, index, 0), torch.where(dist < radius, dist, torch.inf)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("radius", [0.05, 0.2, float("inf")])
def test_nearest_of_the_own_scene_within_the_radius(form, radius):
    points, point_scene = cloud(400, 0)
    vertices, vertex_scene = cloud(300, 1)
    usable = torch.arange(300) % 3 > 0
    index, dist = form(points, point_scene, vertices, vertex_scene, usable, radius)
    want, want_dist = expected(points, point_scene, vertices, vertex_scene, usable, radius)
    assert torch.equal(index, want)
    assert torch.equal(torch.isinf(dist), torch.isinf(want_dist))
    found = torch.isfinite(dist)
    assert 0 < int(found.sum()) <= 400
    assert radius > 1 or not bool(found.all())
    torch.testing.assert_close(dist[found].double(), want_dist[found], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_one_scene_needs_no_numbers(form):
    points, vertices = cloud(50, 2)[0], cloud(40, 3)[0]
    zeros = torch.zeros(50, dtype=torch.int64)
    bare, given = form(points, None, vertices, None), form(points, zeros, vertices, zeros[:40])
    assert torch.equal(bare.vertex, given.vertex)
    assert torch.equal(bare.dist, given.dist)


@pytest.mark.parametrize("form", FORMS)
def test_nothing_to_find(form):
    points, scene = cloud(5, 4)
    none = form(points, scene, points, scene, torch.zeros(5, dtype=torch.bool), 1.0)
    elsewhere = form(points, scene, points, scene + 10)
    empty = form(points, None, points[:0], None)
    for index, dist in (none, elsewhere, empty):
        assert torch.equal(index, torch.zeros(5, dtype=torch.int64))
        assert bool(torch.isinf(dist).all())
    assert len(form(points[:0], scene[:0], points, scene).vertex) == 0


@pytest.mark.parametrize("form", FORMS)
def test_not_finite_points_and_vertices(form):
    points = torch.tensor([[float("nan"), 0.0, 0.0], [0.9, 0.0, 0.0]])
    vertices = torch.tensor([[float("inf"), 0.0, 0.0], [float("nan")] * 3, [0.0, 0.1, 0.0], [1.0, 0.0, 0.0]])
    index, dist = form(points, None, vertices, None)
    assert index.tolist() == [2, 3]
    torch.testing.assert_close(dist, torch.tensor([0.1, 0.1]))


def test_the_first_of_equals_and_small_chunks(monkeypatch):
    # Multiples of 1/64 have distances without any rounding, so that copies of a vertex are equal wherever they stand.
    points, vertices = ((64 * cloud(count, seed)[0]).round() / 64 for count, seed in ((101, 5), (60, 6)))
    vertices = vertices.repeat(3, 1)
    whole = nearest_dense(points, None, vertices, None)
    assert int(whole.vertex.max()) < 60
    monkeypatch.setattr(nearest, "_CHUNK_PAIRS", 1000)
    parts = nearest_dense(points, None, vertices, None)
    assert torch.equal(whole.vertex, parts.vertex)
    assert torch.equal(whole.dist, parts.dist)


@pytest.mark.parametrize("batched", [False, True])
def test_the_dense_form_asks_the_host_nothing(batched):
    # Tensors without data: any operation whose result or shape depends on values raises.
    with FakeTensorMode():
        points, vertices = torch.empty(500, 3), torch.empty(700, 3)
        usable = torch.empty(700, dtype=torch.bool)
        scenes = (torch.empty(500, dtype=torch.int64), torch.empty(700, dtype=torch.int64)) if batched else (None, None)
        index, dist = nearest_dense(points, scenes[0], vertices, scenes[1], usable, 0.03)
        assert index.shape == dist.shape == (500,)
        assert index.dtype == torch.int64
        with pytest.raises(DynamicOutputShapeException):
            (points[:, 0] > 0).nonzero()
        with pytest.raises(DataDependentOutputException):
            bool(usable.any())
