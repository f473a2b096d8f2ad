"""The compiled passes of crossing and depth: against the numpy forms on cloth and skin that cross in many places."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh import compiled_crossing
from hood.mesh.crossing import crossings, self_crossings
from hood.mesh.skin import Sheet, closest_on_triangles, skin_depth
from hood.testing import grid, random_rotation, sphere

pytestmark = pytest.mark.skipif(compiled_crossing.library() is None, reason="no C++ compiler")


def crumpled(cells: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of 1 m that passes through itself."""
    pos, faces = grid(cells, cells, 1.0)
    rng = np.random.default_rng(seed)
    pos = pos - pos.mean(axis=0) + 0.15 * np.sin(7.0 * pos[:, ::-1] + rng.uniform(0, 6, 3)) + rng.normal(0, 0.02, pos.shape)
    return pos @ random_rotation(rng).T, faces


@pytest.mark.parametrize("seed", range(4))
def test_tables_are_those_of_numpy(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pos, faces = crumpled(30, seed)
    ball, ball_faces = sphere(4, 0.4)
    ball[3] = np.nan
    found, own = crossings(pos, faces, ball, ball_faces), self_crossings(pos, faces)
    depth = skin_depth(pos, faces, np.nan_to_num(ball), ball_faces, found, Sheet.of(faces))
    monkeypatch.setattr(compiled_crossing, "library", lambda: None)
    expected = crossings(pos, faces, ball, ball_faces)
    assert len(expected.pairs) > 100
    assert len(own) > 100
    for table, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(table, other)
    np.testing.assert_array_equal(own, self_crossings(pos, faces))
    assert depth > 0.0
    assert depth == pytest.approx(skin_depth(pos, faces, np.nan_to_num(ball), ball_faces, found), abs=1e-12)


def test_more_rows_than_there_is_room_for_are_all_found(monkeypatch: pytest.MonkeyPatch) -> None:
    pos, faces = crumpled(20, 0)
    expected = self_crossings(pos, faces)
    monkeypatch.setattr(compiled_crossing, "_ROOM", 1)
    np.testing.assert_array_equal(self_crossings(pos, faces), expected)


def test_boxes_of_very_different_size_meet_once() -> None:
    """A triangle over the whole scene among small ones, on both sides: compared with every box, and each pair named once."""
    pos, faces = crumpled(40, 1)
    large = np.array([[-3.0, -3, 0.01], [3, -3, 0.02], [0, 5, -0.03]])
    both = np.concatenate([pos, large]), np.concatenate([faces, [[len(pos), len(pos) + 1, len(pos) + 2]]])
    pairs = crossings(*both, large + 0.05, np.array([[0, 1, 2]])).pairs
    assert len(pairs) > 30
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    np.testing.assert_array_equal(pairs[:, ::-1], crossings(large + 0.05, np.array([[0, 1, 2]]), *both).pairs)


def test_the_nearest_of_all_triangles_is_found() -> None:
    pos, faces = crumpled(15, 2)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    row = np.arange(len(points))
    every, corners = np.meshgrid(row, np.arange(len(faces)), indexing="ij"), pos[faces]
    at, weights = closest_on_triangles(points[every[0].ravel()], corners[every[1].ravel()])
    dist = np.linalg.norm(points[every[0].ravel()] - at, axis=1).reshape(len(points), -1)
    found = compiled_crossing.nearest(points, np.full(len(points), 0.2), corners)
    assert found is not None
    reached = dist.min(axis=1) <= 0.2
    assert 20 < reached.sum() < 180
    np.testing.assert_array_equal(found[0] >= 0, reached)
    np.testing.assert_allclose(found[2][reached], dist.min(axis=1)[reached], rtol=1e-12)
    chosen = weights.reshape(len(points), -1, 3)[row[reached], found[0][reached]]
    np.testing.assert_allclose(found[1][reached], chosen, atol=1e-9)
    clear = compiled_crossing.clearance(points, pos)
    np.testing.assert_allclose(clear, np.linalg.norm(points[:, None] - pos, axis=2).min(axis=1), rtol=1e-12)
