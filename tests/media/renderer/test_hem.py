"""Hems: distances from the open edges along the surface, and the lines drawn by them."""

from __future__ import annotations

import numpy as np

from hood.media.pieces import between_hems
from hood.media.renderer.raster import Camera
from hood.media.renderer.render import FAR, RenderMesh, hem_distance, render_frame, sewn
from hood.testing import cylinder, sphere


def test_distance_from_both_ends_of_a_tube() -> None:
    pos, faces = (np.asarray(values) for values in cylinder(40, 30, radius=0.2, height=0.6))
    dist = hem_distance(pos, faces)
    along = np.minimum(pos[:, 1] - pos[:, 1].min(), pos[:, 1].max() - pos[:, 1])
    near = along < 0.055
    assert near.sum() > 100
    np.testing.assert_allclose(dist[near], along[near], atol=1e-3)
    assert (dist[along > 0.1] == FAR).all()


def test_a_surface_near_by_has_hems_of_its_own() -> None:
    """A ball without an open edge a millimetre beside the tube's hem."""
    pos, faces = (np.asarray(values) for values in cylinder(40, 30, radius=0.2, height=0.6))
    ball, ball_faces = sphere(2, 0.1)
    ball = ball + [0.301, pos[:, 1].max(), 0.0]
    both = hem_distance(np.concatenate([pos, ball]), np.concatenate([faces, ball_faces + len(pos)]))
    np.testing.assert_array_equal(both[: len(pos)], hem_distance(pos, faces))
    assert (both[len(pos) :] == FAR).all()
    assert (hem_distance(ball, ball_faces) == FAR).all()
    assert (hem_distance(np.full_like(pos, np.nan), faces) == FAR).all()


def test_an_edge_and_a_seam_are_drawn_and_fade_where_pixels_are_large() -> None:
    dist = np.array([0.0, 0.01, 0.02, 0.03, FAR])
    near = sewn(dist, np.full(5, 5e-4))
    np.testing.assert_allclose(near, [0.7, 1.0, 0.65, 1.0, 1.0])
    far = sewn(dist, np.full(5, 0.03))
    assert near[2] < far[2] < 1.0
    assert far[4] == 1.0


def test_lines_of_a_patch_are_its_own() -> None:
    pos, faces = (np.asarray(values) for values in cylinder(40, 30, radius=0.2, height=0.6))
    patch = pos[faces[0]] * [1.005, 1.0, 1.005]
    both = hem_distance(np.concatenate([pos, patch]), np.concatenate([faces, [[len(pos), len(pos) + 1, len(pos) + 2]]]))
    np.testing.assert_array_equal(both[: len(pos)], hem_distance(pos, faces))
    np.testing.assert_allclose(both[len(pos) :], 0.0, atol=1e-12)


def test_cloth_beside_a_sharp_fold_is_drawn_as_without_it() -> None:
    x, y = (grid.reshape(-1) for grid in np.meshgrid(np.linspace(0.0, 0.4, 9), np.linspace(0.0, 0.2, 5), indexing="ij"))
    number = np.arange(45).reshape(9, 5)
    a, b, c, d = (part.reshape(-1) for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    folded = np.stack([np.minimum(x, 0.4 - x), y, -0.05 * np.maximum(x - 0.2, 0.0)], axis=1)
    camera = Camera((0.1, 0.1, 1.0), (0.1, 0.1, 0.0))
    front = RenderMesh(folded, faces[(x[faces] < 0.21).all(axis=1)])
    pictures = [render_frame([mesh], camera, 80, 80, floor=-1.0).astype(int) for mesh in (front, RenderMesh(folded, faces))]
    assert np.abs(pictures[0] - pictures[1]).max() < 25


def test_no_wedge_is_drawn_where_a_face_lies_between_hems() -> None:
    """A corner of a square, cut off by an edge from hem to hem: all its corners are at the hem, its middle is not."""
    pos = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.0, 0.4, 0.0], [0.4, 0.4, 0.0]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    assert between_hems(faces).tolist() == [0, 1]
    tube, tube_faces = cylinder(12, 4, radius=0.2, height=0.6)
    assert len(between_hems(tube_faces)) == 0
    camera = Camera((0.2, 0.2, 1.0), (0.2, 0.2, 0.0))
    bare, wedge, mended = (
        render_frame([RenderMesh(pos, faces, hem=hem, unsewn=unsewn)], camera, 60, 60, floor=-1.0).astype(int)
        for hem, unsewn in ((None, None), (hem_distance(pos, faces), None), (hem_distance(pos, faces), between_hems(faces)))
    )
    assert np.abs(bare - wedge).max() > 20
    assert np.abs(bare - mended).max() <= 1
