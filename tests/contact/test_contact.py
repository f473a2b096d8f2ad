"""Contact of cloth with a moving obstacle."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.cloth.state import Obstacle, concatenate_obstacles
from hood.contact.contact import find_centroid_contact, find_contact
from hood.testing import assert_nearest, sphere


def ball(radius: float = 0.3, motion: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Obstacle:
    pos, faces = sphere(3, radius)
    now, move = torch.as_tensor(pos), torch.tensor(motion).double()
    return Obstacle(
        now, now + move, now - move, torch.as_tensor(faces), torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long()
    )


def directions(count: int, seed: int = 0) -> torch.Tensor:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return torch.as_tensor(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def scenes(points: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(points), dtype=torch.int64)


@pytest.mark.parametrize("height", [0.05, -0.05])
def test_distance_normal_and_point_of_a_sphere(height: float) -> None:
    outward = directions(200)
    points = outward * (0.3 + height)
    contact = find_contact(points, scenes(points), ball())
    torch.testing.assert_close(contact.dist, torch.full((200,), height).double(), rtol=0, atol=2e-3)
    assert float((contact.normal * outward).sum(dim=1).min()) > 0.999
    torch.testing.assert_close(contact.normal.norm(dim=1), torch.ones(200).double())
    torch.testing.assert_close((points - contact.point).norm(dim=1), contact.dist.abs())
    torch.testing.assert_close(contact.bary.sum(dim=1), torch.ones(200).double())
    assert_nearest(points, ball().pos, contact.vertex)
    torch.testing.assert_close(contact.vertex_dist, (points - ball().pos[contact.vertex]).norm(dim=1))


def test_the_matched_point_moves_with_the_body() -> None:
    points = directions(50) * 0.33
    contact = find_contact(points, scenes(points), ball(motion=(0.02, 0.01, 0.0)))
    motion = (contact.next_point - contact.point).mean(dim=0)
    torch.testing.assert_close(contact.next_point - contact.point, motion.expand(50, 3))
    assert motion.tolist() == pytest.approx([0.02, 0.01, 0.0])
    torch.testing.assert_close(contact.next_normal, contact.normal)
    # Cloth that moves along keeps its distance to the tangent plane.
    torch.testing.assert_close(contact.next_dist(points + motion), contact.next_dist(points + motion).abs())
    torch.testing.assert_close(contact.next_dist(contact.next_point), torch.zeros(50).double(), atol=1e-12, rtol=0)


def test_far_matches_are_kept_but_invalid() -> None:
    points = directions(3) * torch.tensor([[0.35], [0.45], [0.05]]).double()
    contact = find_contact(points, scenes(points), ball(), cap=0.1)
    assert contact.valid.tolist() == [True, False, False]
    assert float(contact.dist[1]) == pytest.approx(0.15, abs=3e-3)


def test_a_batch_searches_each_scene_in_its_own_body() -> None:
    small, large = ball(0.2), ball(0.3)
    both = concatenate_obstacles([small, large])
    points = directions(40) * 0.32
    together = find_contact(torch.cat([points, points]), torch.arange(80) // 40, both)
    for index, alone in enumerate((small, large)):
        single = find_contact(points, scenes(points), alone)
        rows = slice(40 * index, 40 * index + 40)
        torch.testing.assert_close(together.dist[rows], single.dist, rtol=0, atol=1e-12)
        torch.testing.assert_close(together.normal[rows], single.normal, rtol=0, atol=1e-12)
        torch.testing.assert_close(together.point[rows], single.point, rtol=0, atol=1e-12)
        assert bool((both.face_scene[together.face[rows]] == index).all())
        assert torch.equal(together.vertex[rows] - index * len(small.pos), single.vertex)


def test_normals_are_continuous_over_facets() -> None:
    angle = torch.linspace(0, 1.0, 400).double()
    points = 0.31 * torch.stack([angle.cos(), 0 * angle, angle.sin()], dim=1)
    normal = find_contact(points, scenes(points), ball()).normal
    facet = 2 * np.sin(0.5 * 0.14)  # jump of flat normals between neighbouring facets
    assert float((normal[1:] - normal[:-1]).norm(dim=1).max()) < 0.2 * facet


def test_the_face_with_the_nearest_centroid() -> None:
    body = ball(motion=(0.02, 0.01, 0.0))
    points = directions(60) * 0.9  # farther than any cap
    contact = find_contact(points, scenes(points), body)
    found = find_centroid_contact(contact, points, scenes(points), body)
    centroids = body.pos[body.faces].mean(dim=1)
    assert_nearest(points, centroids, found.centroid_face)
    assert bool(found.facing.all())
    move = torch.tensor([0.02, 0.01, 0.0]).double()
    torch.testing.assert_close(found.next_centroid, centroids[found.centroid_face] + move)
    torch.testing.assert_close(found.next_face_normal.norm(dim=1), torch.ones(60).double())
    assert float((found.next_face_normal * directions(60)).sum(dim=1).min()) > 0.98
    assert torch.equal(found.dist, contact.dist)


def test_without_a_surface_no_vertex_faces_anything() -> None:
    body = ball()
    empty = Obstacle(body.pos, body.pos, body.pos, body.faces[:0], body.vertex_scene, body.face_scene[:0])
    points = directions(3)
    found = find_centroid_contact(find_contact(points, scenes(points), body), points, scenes(points), empty)
    assert not bool(found.facing.any())
    assert found.next_centroid.shape == (3, 3)
