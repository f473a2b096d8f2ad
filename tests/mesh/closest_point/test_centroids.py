"""Nearest face centroids, by brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.mesh.closest_point.vertices import nearest_centroids
from hood.testing import assert_nearest, grid, sphere


def test_each_scene_is_searched_by_itself() -> None:
    rng = np.random.default_rng(0)
    bodies = [sphere(1, 0.2), sphere(2, 0.4)]
    count = len(bodies[0][0])
    vertices = torch.as_tensor(np.concatenate([pos for pos, _ in bodies]))
    faces = torch.as_tensor(np.concatenate([bodies[0][1], bodies[1][1] + count]))
    face_scene = torch.arange(2).repeat_interleave(torch.tensor([len(f) for _, f in bodies]))
    points, point_scene = torch.as_tensor(rng.normal(size=(60, 3))), torch.as_tensor(rng.integers(2, size=60))
    face, dist = nearest_centroids(points, point_scene, vertices, faces, face_scene)
    centroids = vertices[faces].mean(dim=1)
    for scene in range(2):
        rows, first = point_scene == scene, scene * len(bodies[0][1])
        assert_nearest(points[rows], centroids[face_scene == scene], face[rows] - first)
    torch.testing.assert_close(dist, (points - centroids[face]).norm(dim=1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_among_many_equally_near_faces_one_of_the_nearest_is_found(dtype: torch.dtype) -> None:
    """High over the middle of a regular sheet the distances of many faces differ by 1e-5 of themselves, or not at all."""
    pos, faces = (torch.as_tensor(x) for x in grid(9, 9, 0.08))
    away = torch.tensor([3.0, 1.0, -2.0])
    for height in (0.3, 0.5, 1.0):
        vertices, points = (pos + away).to(dtype), (pos + away + torch.tensor([0.0, height, 0.0])).to(dtype)
        scene, face_scene = torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long()
        face, dist = nearest_centroids(points, scene, vertices, faces, face_scene)
        centroids = vertices[faces].mean(dim=1)
        assert_nearest(points, centroids, face)
        torch.testing.assert_close(dist, (points - centroids[face]).norm(dim=1))


def test_faces_without_a_normal_are_left_out() -> None:
    vertices = torch.tensor([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0.1, 0, 0.1]]).double()
    faces = torch.tensor([[0, 0, 3], [0, 1, 2], [0, 3, 3]])  # the first and the last are lines by the origin
    scene = torch.tensor([0, 0, 1])
    face, dist = nearest_centroids(torch.zeros(2, 3).double(), torch.tensor([0, 1]), vertices, faces, scene)
    assert int(face[0]) == 1
    assert torch.isfinite(dist).tolist() == [True, False]


def test_no_faces_and_points_that_are_not_finite() -> None:
    pos, faces = (torch.as_tensor(x) for x in sphere(1))
    points = torch.tensor([[float("nan"), 0, 0], [2, 0, 0]]).double()
    scene = torch.zeros(2, dtype=torch.int64)
    face, dist = nearest_centroids(points, scene, pos, faces, torch.zeros(len(faces)).long())
    assert bool(torch.isfinite(dist).all())
    assert float(pos[faces[face[1]]].mean(dim=0)[0]) > 0.7
    _, dist = nearest_centroids(points, scene, pos, faces[:0], scene[:0])
    assert bool(torch.isinf(dist).all())
