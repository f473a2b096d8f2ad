"""Rigid motions of point sets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.mesh.rigid import best_turn


def test_a_turned_set_is_turned_back() -> None:
    points, turn = np.random.default_rng(0).normal(size=(20, 3)), Rotation.from_rotvec([0.3, -2.0, 0.7])
    assert best_turn(points, turn.apply(points)) == pytest.approx(turn.as_matrix())


def test_it_never_mirrors() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert np.linalg.det(best_turn(points, points * [1.0, 1.0, -1.0])) == pytest.approx(1.0)
