"""Fronts that open: two halves that are mirror images, with a slit between vertices in pairs."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh import topology
from hood.testing import cylinder
from tools.assets.placket import WIDTH, open_front, pull_apart, sewn_together, slit_pairs


@pytest.fixture(scope="module")
def tube() -> tuple[np.ndarray, np.ndarray]:
    """A tube around the y axis, open above and below, remeshed to 120 vertices with a slit in front."""
    pos, faces = cylinder(48, 30, 0.15, 0.5)
    return open_front(pos, faces, 120, 0.1)


def test_the_halves_are_mirror_images_joined_at_the_back(tube: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = tube
    image = verts * [-1.0, 1.0, 1.0]
    assert np.linalg.norm(image[:, None] - verts, axis=2).min(axis=1).max() < 1e-12
    assert len(topology.boundary_loops(faces)) == 1
    assert topology.connected_components(len(verts), topology.unique_edges(faces)).max() == 0
    # A disc: sewn together along its front it is the tube again.
    assert len(verts) - len(topology.unique_edges(faces)) + len(faces) == 1
    pairs = slit_pairs(verts, faces)
    assert len(topology.boundary_loops(sewn_together(faces, pairs))) == 2


def test_pairs_are_opposite_of_each_other_from_the_top_down(tube: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = tube
    pairs = slit_pairs(verts, faces)
    right, left = verts[pairs[:, 0]], verts[pairs[:, 1]]
    np.testing.assert_allclose(left - right, np.tile([WIDTH, 0.0, 0.0], (len(pairs), 1)), atol=1e-12)
    assert (np.diff(right[:, 1]) < 0).all()
    np.testing.assert_allclose(right[[0, -1], 1], [verts[:, 1].max(), verts[:, 1].min()], atol=1e-12)
    moved = verts.copy()
    moved[pairs[3, 0]] += 1e-3
    assert np.ptp(pull_apart(moved, pairs)[pairs[3]], axis=0) == pytest.approx([WIDTH, 0.0, 0.0])


def test_what_does_not_reach_around_is_refused() -> None:
    pos, faces = cylinder(48, 30, 0.15, 0.5)
    front = (pos[faces, 2] > 0.1).all(axis=1)
    with pytest.raises(ValueError, match="the half has no edge in the middle"):
        open_front(pos, faces[front], 60, 0.1)
