"""Rigid motions of point sets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.mesh.closest_point import tree
from hood.scene.body_motion.mesh_motion import best_turn, moved, turned


def test_a_turned_set_is_turned_back() -> None:
    points, turn = np.random.default_rng(0).normal(size=(20, 3)), Rotation.from_rotvec([0.3, -2.0, 0.7])
    assert best_turn(points, turn.apply(points)) == pytest.approx(turn.as_matrix())


def test_it_never_mirrors() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert np.linalg.det(best_turn(points, points * [1.0, 1.0, -1.0])) == pytest.approx(1.0)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 3.0, 90.0, 179.0])
def test_how_far_points_move_as_one(degrees: float, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    points, axis = rng.normal(size=(40, 3)), rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    for end in (turn.apply(points) + [0.3, 0.0, -2.0], turn.apply(points) + 0.1 * rng.normal(size=(40, 3))):
        found = moved(points, end)
        with monkeypatch.context() as without:
            without.setattr(tree, "library", lambda: None)
            assert moved(points, end) == pytest.approx(found, abs=2e-6)
        assert found[0] == pytest.approx(turned(points, end), abs=2e-6)
        assert found[1] == pytest.approx(np.linalg.norm(end - points, axis=1).max())
    assert moved(points, turn.apply(points))[0] == pytest.approx(degrees, abs=2e-6)


def test_points_that_are_one_do_not_turn() -> None:
    start = np.ones((5, 3))
    assert moved(start, start + [0.0, 0.2, 0.0]) == pytest.approx((0.0, 0.2))


def test_a_mirrored_set_is_turned_by_as_much_as_without_a_compiler() -> None:
    points = np.random.default_rng(2).normal(size=(20, 3))
    assert moved(points, points * [1.0, 1.0, -1.0])[0] == pytest.approx(turned(points, points * [1.0, 1.0, -1.0]), abs=1e-6)
