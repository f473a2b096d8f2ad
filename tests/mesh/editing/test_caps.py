"""Faces without height: found, and divided along the other diagonal."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.editing.repair import FLAT, find_caps, turn_caps
from hood.mesh.topology import unique_edges

#: A square of two faces; in the second mesh the first face has a further corner, HEIGHT above its longest edge.
HEIGHT = 1e-5
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5 + HEIGHT, 0.5 - HEIGHT, 0]], dtype=float)
WITH_CAP = np.array([[0, 1, 4], [1, 2, 4], [2, 0, 4], [0, 2, 3]])


def area(faces: np.ndarray) -> np.ndarray:
    corners = SQUARE[faces]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]


def turned(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    corners, parent, count = turn_caps(SQUARE, faces)
    return faces[corners[..., 0], corners[..., 1]], parent, count


def test_caps_are_found_by_their_height() -> None:
    assert find_caps(SQUARE, WITH_CAP).tolist() == [False, False, True, False]
    lifted = SQUARE.copy()
    lifted[4, :2] += [2 * FLAT, -2 * FLAT]
    assert not find_caps(lifted, WITH_CAP).any()
    lifted[4] = 0.5 * (SQUARE[0] + SQUARE[2])  # no area is a fault of the file
    assert not find_caps(lifted, WITH_CAP).any()


@pytest.mark.parametrize("shift", range(3))
def test_the_face_behind_is_divided_at_the_corner(shift: int) -> None:
    faces = np.roll(WITH_CAP, shift, axis=1)
    found, parent, count = turned(faces)
    assert count == 1
    assert parent.tolist() == [0, 1, 3, 3]
    assert not find_caps(SQUARE, found).any()
    assert (area(found) > 0.1).all()  # wound as before
    assert area(found).sum() == pytest.approx(area(faces).sum())
    assert len(unique_edges(found)) == len(unique_edges(faces))
    assert [0, 2] not in unique_edges(found).tolist()
    assert [3, 4] in unique_edges(found).tolist()


def test_a_cap_at_an_open_edge_is_left_out() -> None:
    found, parent, count = turned(WITH_CAP[:3])
    assert (count, parent.tolist()) == (1, [0, 1])
    assert np.array_equal(found, WITH_CAP[:2])


def test_a_mesh_without_caps_is_as_it_was() -> None:
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    found, parent, count = turned(faces)
    assert count == 0
    assert np.array_equal(found, faces)
    assert parent.tolist() == [0, 1]


def test_a_cap_behind_an_edge_of_three_faces_stays() -> None:
    faces = np.concatenate([WITH_CAP, [[0, 2, 1]]])
    assert turned(faces)[2] == 0
