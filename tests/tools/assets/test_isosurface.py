"""The zero level of a field as a surface."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh import topology
from tools.assets.isosurface import zero_level

RADIUS = 0.2


def test_the_zero_level_of_a_ball_is_a_closed_sphere_that_faces_outwards() -> None:
    side = np.arange(-0.25, 0.2501, 0.02)
    x, y, z = np.meshgrid(side, side, side, indexing="ij")
    verts, faces = zero_level(np.sqrt(x * x + y * y + z * z) - RADIUS, np.array([-0.25, -0.25, -0.25]), 0.02)
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
