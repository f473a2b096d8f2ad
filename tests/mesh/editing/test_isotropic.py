"""Isotropic remeshing on shapes that are known: a ball, a tube."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh import topology
from hood.mesh.editing.remeshing import collapse_shorter, isotropic, split_long
from hood.testing import cylinder, sphere

Surface = tuple[np.ndarray, np.ndarray]
RADIUS = 0.2


@pytest.fixture(scope="module")
def ball() -> Surface:
    return sphere(4, RADIUS)


@pytest.fixture(scope="module")
def sleeve() -> Surface:
    """An upright tube of radius 0.1 and height 0.3, open at both ends."""
    verts, faces = cylinder(36, 17, radius=0.1, height=0.3)
    return verts + [0.0, 0.05, 0.0], faces


def areas(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corner = verts[faces]
    return 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)


def lengths(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    edges = topology.unique_edges(faces)
    return np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)


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
