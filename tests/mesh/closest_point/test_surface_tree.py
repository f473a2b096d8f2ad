"""The compiled search: what a surface in motion, a batch and a history of searches must not change."""

import numpy as np
import pytest
import torch

from hood.cloth.state import Obstacle
from hood.contact.contact import find_contact
from hood.mesh.closest_point import tree as surface_tree
from hood.mesh.closest_point.search import build_incidence, search_surface
from hood.testing import box, sphere

pytestmark = pytest.mark.skipif(surface_tree.library() is None, reason="no C++ compiler")


def zeros(count):
    return torch.zeros(count, dtype=torch.int64)


def found(points, pos, faces):
    return surface_tree.search(
        points, zeros(len(points)), pos, faces, zeros(len(faces)), build_incidence(faces, len(pos)).adjacency, pos, True
    )


def surface(mesh=None):
    pos, faces = mesh or sphere(3)
    return torch.as_tensor(pos), torch.as_tensor(faces)


def points(count, seed=0, spread=1.5):
    return spread * torch.as_tensor(np.random.default_rng(seed).normal(size=(count, 3)))


def test_a_search_does_not_depend_on_those_before_it():
    pos, faces = surface()
    where = points(200)
    fresh = found(where, pos, faces.clone() + 0)
    for seed in (1, 2):  # other places, a crushed surface, another count
        found(points(200, seed), pos, faces)
        found(where, 0.1 * pos.flip(1), faces)
        found(points(7, seed), pos, faces)
    again = found(where, pos, faces)
    for name in ("vertex", "face", "dist", "bary", "vertex_dist", "normal", "curvature"):
        assert torch.equal(getattr(again, name), getattr(fresh, name)), name


def test_the_same_points_are_not_searched_for_again(monkeypatch):
    pos, faces = surface()
    where, later = points(50), surface()[0] + 0.1
    adjacency, scenes = build_incidence(faces, len(pos)).adjacency, (zeros(50), zeros(len(faces)))
    fresh = surface_tree.search(where, scenes[0], pos, faces, scenes[1], adjacency, later, True)
    found(points(50, 1), pos, faces)
    dist = surface_tree.distance(where, scenes[0], pos.clone(), faces, scenes[1], adjacency)
    library = surface_tree.library()

    class Forbidden:
        def __getattr__(self, name):
            assert name not in ("surface_find", "surface_refit"), "searched again"
            return getattr(library, name)

    for _, _, tree in surface_tree._TREES:
        monkeypatch.setattr(tree, "_lib", Forbidden())
    again = surface_tree.search(where.clone(), scenes[0], pos.clone(), faces, scenes[1], adjacency, later, True)
    assert torch.equal(dist, fresh.dist)
    for name in fresh._fields:
        assert torch.equal(getattr(again, name), getattr(fresh, name)), name
    with pytest.raises(AssertionError, match="searched again"):
        surface_tree.search(where + 1e-9, scenes[0], pos, faces, scenes[1], adjacency, later, True)


def test_what_is_found_does_not_depend_on_the_threads(monkeypatch):
    pos, faces = surface()
    for seed, count in ((0, 500), (1, 3), (2, 130)):
        where = points(count, seed)
        where[: count // 2] *= 0.7  # inside and outside, beside vertices and edges
        where[-1] = pos[5]
        fresh = found(where, pos * (1 + seed), faces)
        for parts in (2, 7):
            monkeypatch.setattr(surface_tree, "num_parts", lambda count, least, parts=parts: parts)
            again = found(where, pos * (1 + seed), faces)
            assert all(torch.equal(a, b) for a, b in zip(again, fresh, strict=True))
        monkeypatch.undo()


def test_what_was_near_before_changes_nothing_but_the_visits():
    pos, faces = surface()
    where = points(300)
    found(where, pos, faces)
    (tree,) = [tree for _, _, tree in surface_tree._TREES if tree._tree.num_vertices == len(pos)][-1:]
    generator = np.random.default_rng(0)
    for step in range(6):  # the surface and the points move on; places that are not finite and vertices far away are known too
        moved, there = pos * (1 + 0.3 * step) + 0.1 * step * pos.flip(1), where.roll(step, 1) + 0.2 * step
        moved[step], there[2 * step] = torch.nan, torch.nan
        if step % 2:
            tree._near[300] = generator.integers(0, len(faces), 300)
        assert len(tree._near[300]) == 300
        known = found(there, moved, faces)
        surface_tree.forget_searches()
        assert not tree._near
        fresh = found(there, moved, faces)
        assert all(torch.equal(a.nan_to_num(-7), b.nan_to_num(-7)) for a, b in zip(known, fresh, strict=True))


def test_a_far_search_visits_less_after_one_like_it():
    """The way from a point is bounded by what was nearest before, so a list of leaves that was full is short."""
    pos, faces = surface()
    tree = surface_tree.SurfaceTree(
        faces.numpy(), np.arange(len(faces)), [part.numpy() for part in build_incidence(faces, len(pos)).adjacency], pos
    )
    where = np.ascontiguousarray(40.0 * points(400).numpy())
    visits = []
    for _ in range(2):
        lists = [tree._arrays[name] for name in ("visits", "next_visits")]
        for visited in lists:
            visited.fill(-1)
        tree.search(where, pos, pos.numpy(), False)
        visits.append(sum(int((visited >= 0).sum()) for visited in lists))
    assert visits[1] < visits[0]


def test_of_faces_at_the_same_distance_the_first_is_taken():
    pos, faces = surface(box(4))
    corners = pos[:: max(len(pos) // 6, 1)]
    hit = found(2.0 * corners, pos, faces)
    for row, point in enumerate(2.0 * corners):
        alone = [float(found(point[None], pos, faces[[k]]).dist.abs()) for k in range(len(faces))]
        assert int(hit.face[row]) == int(np.flatnonzero(np.array(alone) == min(alone))[0])


def test_nearest_vertices_are_those_of_all():
    pos, faces = surface()
    where = points(300)
    dist = (where[:, None] - pos[None]).norm(dim=2)
    hit = found(where, pos, faces)
    torch.testing.assert_close(hit.vertex_dist, dist.min(dim=1).values, rtol=1e-13, atol=0)


@pytest.mark.parametrize("size", [1.0, 1e39])
def test_places_that_boxes_in_float32_do_not_hold(size):
    pos, faces = surface()
    where, pos = 1e39 * points(50), size * pos
    dist = (where[:, None] - pos[None]).norm(dim=2)
    torch.testing.assert_close(found(where, pos, faces).vertex_dist, dist.min(dim=1).values, rtol=1e-13, atol=0)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 63, 64, 65, 200])
def test_surfaces_of_any_size(count):
    pos, faces = surface()
    part, where = faces[:count], points(50)
    expected = torch.stack([found(where, pos, part[[k]]).dist.abs() for k in range(len(part))]).min(dim=0).values
    torch.testing.assert_close(found(where, pos, part).dist.abs(), expected, rtol=0, atol=0)


@pytest.mark.parametrize("away", [1e-9, 1e2, 1e7, 1e200])
def test_points_far_from_the_surface_and_on_it_find_the_closest_face(away):
    pos, faces = surface()
    part, directions = faces[::7], points(70)
    where = directions * away if away > 1.0 else pos[part].mean(dim=1)[:70] + directions * away
    expected = torch.stack([found(where, pos, part[[k]]).dist.abs() for k in range(len(part))]).min(dim=0).values
    torch.testing.assert_close(found(where, pos, part).dist.abs(), expected, rtol=0, atol=0)


def test_a_point_is_found_alike_alone_and_among_others():
    pos, faces = surface()
    where = points(130)
    together, alone = found(where, pos, faces), [found(row[None], pos, faces) for row in where]
    for name in together._fields:
        assert torch.equal(getattr(together, name), torch.cat([getattr(one, name) for one in alone])), name


def test_contact_of_a_moving_batch_is_that_of_the_torch_form(monkeypatch):
    pos, faces = surface()
    both = torch.cat([pos, pos + 5.0])
    turned = both + 0.01 * both.flip(1)
    scene, face_scene = torch.arange(2).repeat_interleave(len(pos)), torch.arange(2).repeat_interleave(len(faces))
    obstacle = Obstacle(both, turned, both, torch.cat([faces, faces + len(pos)]), scene, face_scene)
    where = torch.cat([points(100, spread=0.7), points(80, 1, spread=0.7) + 5.0])
    owner = torch.tensor([0] * 100 + [1] * 80)
    compiled = find_contact(where, owner, obstacle)
    monkeypatch.setattr(surface_tree, "library", lambda: None)
    plain = find_contact(where, owner, obstacle)
    for name in ("dist", "point", "normal", "next_point", "next_normal", "vertex_dist", "curvature"):
        torch.testing.assert_close(getattr(compiled, name), getattr(plain, name), rtol=0, atol=1e-11)
    assert torch.equal(compiled.valid, plain.valid)
    assert compiled.dist.dtype == where.dtype


def test_points_and_surfaces_that_are_not_finite_break_nothing():
    pos, faces = surface()
    where = points(4)
    where[1] = torch.nan
    hit = found(where, pos, faces)
    assert torch.isnan(hit.dist[1])
    assert torch.isfinite(hit.dist[[0, 2, 3]]).all()
    lost = found(points(4), torch.full_like(pos, torch.nan), faces)
    assert int(lost.face.max()) < len(faces)
    assert int(lost.vertex.max()) < len(pos)


def test_scenes_without_a_surface_are_infinitely_far():
    pos, faces = surface()
    owner = torch.tensor([0, 1, 0])
    hit = search_surface(points(3), owner, pos, faces, zeros(len(pos)), zeros(len(faces)))
    assert torch.isinf(hit.dist).tolist() == [False, True, False]
