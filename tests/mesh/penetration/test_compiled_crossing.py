"""The compiled passes of crossing and depth: against the numpy forms on cloth and skin that cross in many places."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.penetration import compiled
from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.mesh.penetration.exposure import Sheet, skin_depth
from hood.testing import grid, random_rotation, sphere

pytestmark = pytest.mark.skipif(compiled.library() is None, reason="no C++ compiler")


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
    monkeypatch.setattr(compiled, "library", lambda: None)
    expected = crossings(pos, faces, ball, ball_faces)
    assert len(expected.pairs) > 100
    assert len(own) > 100
    for table, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(table, other)
    np.testing.assert_array_equal(own, self_crossings(pos, faces))
    assert depth > 0.0
    assert depth == pytest.approx(skin_depth(pos, faces, np.nan_to_num(ball), ball_faces, found), abs=1e-12)


def test_what_is_found_does_not_depend_on_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor the room that there is at first."""
    pos, faces = crumpled(30, 5)
    ball, ball_faces = sphere(4, 0.4)
    expected, own = crossings(pos, faces, ball, ball_faces), self_crossings(pos, faces)
    for threads, room in ((2, 4096), (3, 1), (64, 50)):
        monkeypatch.setattr(compiled, "num_parts", lambda count, least, threads=threads: threads)
        monkeypatch.setattr(compiled, "_ROOM", room)
        for _ in range(5):
            for table, other in zip(crossings(pos, faces, ball, ball_faces), expected, strict=True):
                np.testing.assert_array_equal(table, other)
            np.testing.assert_array_equal(self_crossings(pos, faces), own)
        assert len(crossings(pos, faces, ball, ball_faces[:0]).pairs) == 0


def test_more_rows_than_there_is_room_for_are_all_found(monkeypatch: pytest.MonkeyPatch) -> None:
    pos, faces = crumpled(20, 0)
    expected = self_crossings(pos, faces)
    monkeypatch.setattr(compiled, "_ROOM", 1)
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


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("size", [0.1, 0.4])
def test_depth_is_that_of_numpy(seed: int, size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """On crumpled cloth over a ball, finer and coarser than it, with a vertex of the skin without a face."""
    pos, faces = crumpled(12 + 6 * seed, seed)
    ball, ball_faces = sphere(3 + seed % 2, size)
    ball = np.concatenate([ball + pos[len(pos) // 2] + 0.03, pos[:1]])
    cut = crossings(pos, faces, ball, ball_faces)
    assert len(cut.pairs) > 10
    depth = skin_depth(pos, faces, ball, ball_faces, cut)
    monkeypatch.setattr(compiled, "library", lambda: None)
    assert depth == pytest.approx(skin_depth(pos, faces, ball, ball_faces, cut), abs=1e-12)


def test_what_is_kept_of_the_faces_and_its_order_do_not_matter() -> None:
    """CorrectionPasses over other positions in between, and an order by another shape, change nothing."""
    pos, faces = crumpled(25, 3)
    ball, ball_faces = sphere(4, 0.4)
    cut, own = crossings(pos, faces, ball, ball_faces), self_crossings(pos, faces)
    depth = skin_depth(pos, faces, ball, ball_faces, cut)
    for shape in (pos, crumpled(25, 4)[0], np.zeros_like(pos)):
        cloth, skin = compiled.eights(faces, shape), compiled.eights(ball_faces, ball[::-1])
        assert cloth is not None
        assert skin is not None
        for moved in (0.5 * pos, pos):
            found, pairs = crossings(moved, faces, ball, ball_faces, (cloth, skin)), self_crossings(moved, faces, cloth)
            height = skin_depth(moved, faces, ball, ball_faces, found, both=(cloth, skin))
        for table, other in zip(found, cut, strict=True):
            np.testing.assert_array_equal(table, other)
        np.testing.assert_array_equal(pairs, own)
        assert height == depth
