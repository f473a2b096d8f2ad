"""Contact at points inside the cloth's edges and faces."""

from __future__ import annotations

import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, concatenate_obstacles
from hood.contact.contact import find_contact
from hood.contact.sample_points import PointContact, find_point_contact
from hood.mesh.closest_point import tree
from hood.mesh.geometry import vertex_masses
from hood.testing import box, cylinder, grid, sphere

F64 = torch.float64


def body(pos, faces, motion=(0.0, 0.0, 0.0)) -> Obstacle:
    now = torch.as_tensor(pos, dtype=F64)
    zeros = torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long()
    return Obstacle(now, now + torch.tensor(motion, dtype=F64), now, torch.as_tensor(faces), *zeros)


def found(place: str, cloth: Cloth, pos: torch.Tensor, obstacle: Obstacle) -> PointContact:
    return find_point_contact(place, cloth, pos, obstacle, find_contact(pos, cloth.vertex_scene, obstacle))


def shirt_on_ball(radius: float = 0.102) -> tuple[Cloth, torch.Tensor, Obstacle]:
    pos, faces = sphere(2, radius)
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    return cloth, cloth.rest_pos, body(*sphere(3, 0.1), motion=(0.01, 0.0, 0.0))


def test_midpoints_are_matched_like_vertices_there() -> None:
    cloth, pos, obstacle = shirt_on_ball()
    points = found("edges", cloth, pos, obstacle)
    assert len(points.dist) == len(cloth.edges)
    middles = 0.5 * (pos[cloth.edges[:, 0]] + pos[cloth.edges[:, 1]])
    torch.testing.assert_close(points.at(pos), middles)
    contact = find_contact(middles, cloth.edge_scene, obstacle)
    for name in ("dist", "point", "next_point", "next_normal"):
        assert torch.equal(getattr(points, name), getattr(contact, name)), name
    # Edges of chords chord error below the vertices, which is what vertices alone do not see.
    assert float(points.dist.max()) < float(find_contact(pos, cloth.vertex_scene, obstacle).dist.min())


def test_shares_are_areas_in_units_of_those_of_the_vertices() -> None:
    """All points of a closed cloth together stand for as much as its vertices: its area."""
    cloth, pos, obstacle = shirt_on_ball()
    areas = vertex_masses(cloth.rest_pos, cloth.faces, 1.0)
    edges = found("edges", cloth, pos, obstacle)
    held = edges.share * (edges.weights * areas[edges.vertices]).sum(dim=1)
    assert float(held.sum()) == pytest.approx(float(areas.sum()))
    assert float(edges.share.sum()) == pytest.approx(cloth.num_vertices, rel=0.02)
    strict = found("strict", cloth, pos, obstacle)  # a closed surface has no rim
    assert len(strict.dist) == len(obstacle.pos)
    held = strict.share * (strict.weights * areas[strict.vertices]).sum(dim=1)
    assert float(held.sum()) == pytest.approx(float(vertex_masses(obstacle.pos, obstacle.faces, 1.0).sum()))


def test_a_body_vertex_is_matched_with_the_nearest_cloth() -> None:
    cloth, pos, obstacle = shirt_on_ball()
    points = found("strict", cloth, pos, obstacle)
    torch.testing.assert_close(points.weights.sum(dim=1), torch.ones(len(points.dist), dtype=F64))
    assert bool((points.weights >= 0).all())
    gap = points.at(pos) - points.point
    surface = Obstacle(pos, pos, pos, cloth.faces, cloth.vertex_scene, cloth.face_scene)
    nearest = find_contact(obstacle.pos, obstacle.vertex_scene, surface)
    torch.testing.assert_close(gap.norm(dim=1), nearest.dist.abs())
    # On a ball the vertices' normals are radial to a degree.
    torch.testing.assert_close(points.dist, (gap * points.point).sum(dim=1) / 0.1, rtol=0, atol=1e-5)
    torch.testing.assert_close(points.next_point - points.point, torch.tensor([0.01, 0.0, 0.0], dtype=F64).expand_as(gap))


def test_bare_skin_beyond_a_hem_is_not_under_cloth() -> None:
    """A sleeve that ends half-way along an arm that gets thicker there: the hem is below the tangent planes of bare skin."""
    sleeve, faces = cylinder(16, 8, 0.052, 0.2)
    arm, arm_faces = cylinder(24, 24, 0.05, 0.6)
    axis = int((arm.max(0) - arm.min(0)).argmax())
    along = arm[:, axis] - arm[:, axis].mean()
    thick = arm.copy()
    for other in {0, 1, 2} - {axis}:
        thick[:, other] *= 1.0 + 0.5 * (abs(along) > 0.12) * (abs(along) - 0.12) / 0.05
    sleeve[:, axis] += arm[:, axis].mean() - sleeve[:, axis].mean()
    cloth = build_cloth(sleeve, faces, Material(), dtype=F64)
    points = found("strict", cloth, cloth.rest_pos, body(thick, arm_faces))
    skin = points.weights[:, 2] > 0
    reach = (points.point[:, axis] - arm[:, axis].mean()).abs()
    assert 50 < int(skin.sum())
    assert float(reach.max()) < 0.105  # the sleeve ends at 0.1, the next ring of the arm is at 0.117
    assert float(points.dist.min()) > -0.002


def test_skin_that_looks_away_is_not_under_cloth() -> None:
    """Cloth on a slab of 10 mm is below the tangent planes of its lower side, 12 mm away."""
    slab, slab_faces = box(6, 0.3)
    low, high = slab.min(axis=0), slab.max(axis=0)
    slab = slab * [1.0, 0.01 / (high - low)[1], 1.0]
    pos, faces = grid(8, 8, 0.2)
    cloth = build_cloth(pos - pos.mean(axis=0) + slab.mean(axis=0) + [0.0, 0.007, 0.0], faces, Material(), dtype=F64)
    points = found("strict", cloth, cloth.rest_pos, body(slab, slab_faces))
    skin = points.weights[:, 2] > 0
    assert int(skin.sum()) >= 9
    assert float((points.dist - 0.002).abs().max()) < 1e-6


def test_rims_alone_have_midpoints_in_the_strict_form() -> None:
    pos, faces = grid(4, 4, 0.1)
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    floor, floor_faces = grid(2, 2, 4.0)
    under = body(floor - [2.0, 0.003, 2.0], floor_faces)
    points = found("strict", cloth, cloth.rest_pos, under)
    middles = (points.weights == torch.tensor([0.5, 0.5, 0.0], dtype=F64)).all(dim=1)
    assert int(middles.sum()) == 12
    assert float(points.share.max()) <= 1.0
    assert len(found("edges", cloth, cloth.rest_pos, under).dist) == len(cloth.edges) == 33
    far = cloth.rest_pos + torch.tensor([0.0, 0.05, 0.0])
    assert len(found("edges", cloth, far, under).dist) == len(found("strict", cloth, far, under).dist) == 0


@pytest.mark.parametrize("place", ["edges", "strict"])
def test_a_batch_has_the_points_of_its_scenes(place: str) -> None:
    cloth, pos, obstacle = shirt_on_ball()
    pos_two, faces_two = grid(4, 4, 0.1)
    other = build_cloth(pos_two - [0.05, -0.1015, 0.05], faces_two, Material(), dtype=F64)
    one, two = found(place, cloth, pos, obstacle), found(place, other, other.rest_pos, obstacle)
    assert len(two.dist) > 0
    both = concatenate_cloths([cloth, other])
    joined = found(place, both, torch.cat([pos, other.rest_pos]), concatenate_obstacles([obstacle, obstacle]))
    for index, (alone, shift) in enumerate(((one, 0), (two, cloth.num_vertices))):
        rows = joined.scene == index
        assert torch.equal(joined.vertices[rows] - shift, alone.vertices)
        for name in ("weights", "share", "dist", "point", "next_point", "next_normal"):
            torch.testing.assert_close(getattr(joined, name)[rows], getattr(alone, name))


@pytest.mark.parametrize("place", ["edges", "strict"])
def test_the_search_in_torch_finds_the_same(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cloth, pos, obstacle = shirt_on_ball()
    pos = pos + 1e-3 * torch.randn(pos.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    compiled = found(place, cloth, pos, obstacle)
    monkeypatch.setattr(tree, "library", lambda: None)
    plain = found(place, cloth, pos, obstacle)
    torch.testing.assert_close(plain.at(pos), compiled.at(pos), rtol=0, atol=1e-6)
    torch.testing.assert_close(plain.dist, compiled.dist, rtol=0, atol=1e-6)
