"""From a field to an even mesh laid flat: what the tailor is built from, on shapes that are known."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hood.assets.isosurface import zero_level
from hood.assets.isotropic import collapse_shorter, isotropic, split_long
from hood.assets.remesh import cut, largest_component, smooth_loops
from hood.assets.unwrap import flatten, panels, unwrap
from hood.mesh import topology
from hood.testing import cylinder

Surface = tuple[np.ndarray, np.ndarray]
RADIUS = 0.2


@pytest.fixture(scope="module")
def ball() -> Surface:
    side = np.arange(-0.25, 0.2501, 0.02)
    x, y, z = np.meshgrid(side, side, side, indexing="ij")
    return zero_level(np.sqrt(x * x + y * y + z * z) - RADIUS, np.array([-0.25, -0.25, -0.25]), 0.02)


@pytest.fixture(scope="module")
def sleeve() -> Surface:
    """An upright tube of radius 0.1 and height 0.3, open at both ends."""
    side = np.arange(-0.16, 0.1601, 0.02)
    height = np.arange(0.0, 0.4001, 0.02)
    x, y, z = np.meshgrid(side, height, side, indexing="ij")
    verts, faces = zero_level(np.sqrt(x * x + z * z) - 0.1, np.array([-0.16, 0.0, -0.16]), 0.02)
    verts, faces = cut(verts, faces, 0.35 - verts[:, 1])
    return largest_component(*cut(verts, faces, verts[:, 1] - 0.05))


def areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corner = verts[faces]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def lengths(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    edges = topology.unique_edges(faces)
    return np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)


def test_the_zero_level_of_a_ball_is_a_closed_sphere_that_faces_outwards(ball: Surface) -> None:
    verts, faces = ball
    assert len(topology.boundary_loops(faces)) == 0
    assert len(verts) - len(topology.unique_edges(faces)) + len(faces) == 2
    assert np.abs(np.linalg.norm(verts, axis=1) - RADIUS).max() < 2e-3
    corner = verts[faces]
    volume = np.einsum("fa,fa->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)


def test_a_surface_that_leaves_the_grid_is_open_there() -> None:
    field = np.broadcast_to(np.linspace(-1.0, 1.1, 8)[:, None, None], (8, 5, 5))
    verts, faces = zero_level(field, np.zeros(3), 1.0)
    assert len(topology.boundary_loops(faces)) == 1
    assert np.ptp(verts[:, 0]) == pytest.approx(0.0)


@pytest.mark.parametrize("count", [150, 600])
def test_isotropic_gives_the_count_even_edges_and_the_same_surface(ball: Surface, count: int) -> None:
    verts, faces = isotropic(*ball, count)
    assert len(verts) == pytest.approx(count, rel=0.05)
    assert len(verts) - len(topology.unique_edges(faces)) + len(faces) == 2
    relative = lengths(verts, faces) / lengths(verts, faces).mean()
    assert 0.55 < relative.min() < relative.max() < 1.45
    assert np.abs(np.linalg.norm(verts, axis=1) - RADIUS).max() < 3e-3


def test_isotropic_keeps_hems_on_their_curves(sleeve: Surface) -> None:
    verts, faces = isotropic(*sleeve, 300)
    loops = topology.boundary_loops(faces)
    assert len(loops) == 2
    for loop in loops:
        height = verts[loop, 1]
        assert np.ptp(height) < 1e-3
        assert min(abs(height.mean() - 0.05), abs(height.mean() - 0.35)) < 1e-3
        assert np.abs(np.hypot(verts[loop, 0], verts[loop, 2]) - 0.1).max() < 2e-3


def test_isotropic_does_the_same_every_time(sleeve: Surface) -> None:
    first, second = isotropic(*sleeve, 200), isotropic(*sleeve, 200)
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


def test_split_and_collapse_reach_their_limits(ball: Surface) -> None:
    verts, faces = split_long(*ball, 0.012)
    assert lengths(verts, faces).max() <= 0.012
    assert areas(verts, faces).sum() == pytest.approx(areas(*ball).sum())
    coarse, coarse_faces = collapse_shorter(*ball, 0.03, 0.06)
    assert len(coarse) < 0.7 * len(ball[0])
    assert lengths(coarse, coarse_faces).max() <= 0.06 + 1e-12
    assert len(coarse) - len(topology.unique_edges(coarse_faces)) + len(coarse_faces) == 2


def test_a_sleeve_has_two_panels_that_lie_flat_without_stretch(sleeve: Surface) -> None:
    verts, faces = isotropic(*sleeve, 400)
    panel = panels(verts, faces)
    assert set(np.unique(panel)) == {0, 1}
    assert 0.45 < panel.mean() < 0.55
    facing = np.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])[:, 2]
    assert facing[panel == 0].mean() > 0 > facing[panel == 1].mean()
    uv, uv_faces = unwrap(verts, faces, panel)
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1).astype(np.float64)
    corner = flat[uv_faces]
    signed = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] / 2
    assert signed.min() > 0
    scale = np.sqrt(signed / areas(verts, faces))
    assert scale.max() / scale.min() < 1.1
    assert (uv.min(), uv.max()) >= (0.0, 0.0)
    assert uv.max() <= 1.0
    assert uv[uv_faces[panel == 0], 0].max() < uv[uv_faces[panel == 1], 0].min()


def test_a_part_has_panels_of_its_own(sleeve: Surface) -> None:
    verts, faces = isotropic(*sleeve, 400)
    panel = panels(verts, faces, [verts[:, 0]])
    assert set(np.unique(panel)) == {0, 1, 2, 3}
    assert verts[faces[panel < 2], 0].mean() > 0 > verts[faces[panel >= 2], 0].mean()
    uv, uv_faces = unwrap(verts, faces, panel)
    assert topology.connected_components(len(uv), topology.unique_edges(uv_faces)).max() == 3
    ends = [(uv[uv_faces[panel == side], 0].min(), uv[uv_faces[panel == side], 0].max()) for side in range(4)]
    assert all(one[1] < other[0] for one, other in pairwise(ends))


@pytest.mark.parametrize("num_vertices", [6, 12, 40])
def test_smoothing_keeps_the_length_of_openings(num_vertices: int) -> None:
    verts, faces = cylinder(num_vertices, 3, radius=0.035, height=0.1)
    (loop, _), smooth = topology.boundary_loops(faces), smooth_loops(verts, faces, 6)
    before, after = (np.linalg.norm(pos[loop] - np.roll(pos[loop], 1, axis=0), axis=1).sum() for pos in (verts, smooth))
    assert after == pytest.approx(before, rel=0.01)


def test_half_a_cylinder_flattens_to_its_own_rectangle() -> None:
    angle, height = np.meshgrid(np.linspace(0.0, np.pi, 13), np.linspace(0.0, 0.3, 7), indexing="ij")
    verts = np.stack([-0.1 * np.cos(angle), height, 0.1 * np.sin(angle)], axis=-1).reshape(-1, 3)
    at = np.arange(91).reshape(13, 7)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    plane = flatten(verts, faces)
    edges = topology.unique_edges(faces)
    length = np.linalg.norm(plane[edges[:, 0]] - plane[edges[:, 1]], axis=1)
    np.testing.assert_allclose(length, np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1), rtol=0.02)
