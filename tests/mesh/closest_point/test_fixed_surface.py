"""The search of fixed shapes finds what the torch form of the search finds."""

import numpy as np
import pytest
import torch

from hood.mesh.closest_point import tree
from hood.mesh.closest_point.search import build_incidence, search_surface
from hood.mesh.closest_point.static_shapes import search_surface_fixed
from hood.tensors.batch import gather_true
from hood.testing import box, sphere


def surfaces(*meshes):
    """Vertices, faces and their scenes of several surfaces, one scene each."""
    counts = np.cumsum([0, *(len(pos) for pos, _ in meshes)])
    vertices = torch.as_tensor(np.concatenate([pos for pos, _ in meshes]))
    faces = torch.as_tensor(np.concatenate([tri + first for (_, tri), first in zip(meshes, counts, strict=False)]))
    sizes = [[len(mesh[part]) for mesh in meshes] for part in (0, 1)]
    scenes = [torch.repeat_interleave(torch.arange(len(meshes)), torch.tensor(size)) for size in sizes]
    return vertices, faces, *scenes


def floor_and_ball():
    """A ball on a floor of two faces: these are far larger than the rest."""
    pos, tri = sphere(2)
    ground = np.array([[-20.0, -1.0, -20.0], [20.0, -1.0, -20.0], [20.0, -1.0, 20.0], [-20.0, -1.0, 20.0]])
    square = np.array([[0, 2, 1], [0, 3, 2]])
    return np.concatenate([pos, ground]), np.concatenate([tri, square + len(pos)])


CASES = {
    "ball": [sphere(3)],
    "small": [box(1)],
    "floor": [floor_and_ball()],
    "batch": [sphere(2), box(1), floor_and_ball()],
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_found(name, monkeypatch):
    monkeypatch.setattr(tree, "library", lambda: None)
    vertices, faces, vertex_scene, face_scene = surfaces(*CASES[name])
    generator = torch.Generator().manual_seed(0)
    count = 200 * len(CASES[name])
    points = 1.3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    scene = torch.arange(count) % len(CASES[name])
    given = (points, scene, vertices, faces, vertex_scene, face_scene)
    expected = search_surface(*given)
    incidence = build_incidence(faces, len(vertices))
    _, needed = search_surface_fixed(*given, incidence, len(CASES[name]), 0)
    assert (int(needed) > 0) == (name != "ball")
    for places in {int(needed), int(needed) + 5}:
        hit, again = search_surface_fixed(*given, incidence, len(CASES[name]), places)
        assert int(again) == int(needed)
        assert torch.equal(hit.vertex, expected.vertex)
        for value, reference in ((hit.vertex_dist, expected.vertex_dist), (hit.dist, expected.dist)):
            torch.testing.assert_close(value, reference, rtol=1e-12, atol=1e-12)
        same = hit.face == expected.face  # equally near faces are told apart by rounding
        torch.testing.assert_close(hit.bary[same], expected.bary[same], rtol=1e-9, atol=1e-9)
        assert float(same.double().mean()) > 0.9


def test_a_point_far_from_the_corners_of_a_large_face():
    vertices, faces, vertex_scene, face_scene = surfaces(floor_and_ball())
    points = torch.tensor([[10.0, -0.9, 8.0]], dtype=torch.float64)
    given = (points, torch.zeros(1, dtype=torch.int64), vertices, faces, vertex_scene, face_scene)
    incidence = build_incidence(faces, len(vertices))
    hit, needed = search_surface_fixed(*given, incidence, 1, int(search_surface_fixed(*given, incidence, 1, 0)[1]))
    assert float(hit.dist.abs()) == pytest.approx(0.1)
    assert int(needed) == 2


def test_a_scene_without_a_surface_finds_nothing():
    vertices, faces, vertex_scene, face_scene = surfaces(sphere(2))
    points = torch.tensor([[0.5, 0.0, 0.0], [0.5, 0.0, 0.0]], dtype=torch.float64)
    given = (points, torch.tensor([0, 1]), vertices, faces, vertex_scene, face_scene)
    hit, _ = search_surface_fixed(*given, build_incidence(faces, len(vertices)), 2, 0)
    assert hit.dist.isinf().tolist() == [False, True]
    assert hit.vertex_dist.isinf().tolist() == [False, True]


def test_true_entries_in_places():
    mask = torch.tensor([False, True, True, False, True])
    assert gather_true(mask, 5).tolist() == [1, 2, 4, 5, 5]
    assert gather_true(mask, 3).tolist() == [1, 2, 5]
    assert gather_true(mask, 1).tolist() == [5]
