"""Held vertices on their way through a step: they reach their targets, or stop before cloth meets cloth."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.cloth_proximity import ClothSurface, Followed, LayerMesh, follow
from hood.mesh.penetration.crossing import self_crossings
from hood.testing import grid

pytestmark = pytest.mark.usefixtures("compiled_layers")

_SIZE = 49
_MIDDLE = np.array([16, 17, 18, 23, 24, 25, 30, 31, 32])


def _sheets(gap: float = 0.01) -> tuple[LayerMesh, np.ndarray, np.ndarray]:
    """Two sheets of 7 by 7 vertices over each other."""
    pos, faces = grid(7, 7, 0.3)
    rest, both = np.concatenate([pos, pos + [0.011, gap, 0.007]]), np.concatenate([faces, faces + len(pos)])
    return LayerMesh(rest, both, 3e-3), rest, both


def _held(*rows: np.ndarray) -> np.ndarray:
    held = np.zeros(2 * _SIZE, bool)
    held[np.concatenate(rows)] = True
    return held


def _follow(mesh: LayerMesh, pos: np.ndarray, held: np.ndarray, target: np.ndarray) -> Followed:
    return follow(ClothSurface(mesh, pos, held, 20.0), pos, held, target)


def _free_way(mesh: LayerMesh, pos: np.ndarray, there: np.ndarray) -> bool:
    return ClothSurface(mesh, pos, np.zeros(len(pos), bool), 1.0).limit(pos, there) == 1.0


def test_free_layers_make_way() -> None:
    mesh, pos, faces = _sheets()
    held = _held(_MIDDLE + _SIZE)
    target = pos.copy()
    target[held] -= [0.0, 0.05, 0.0]
    found = _follow(mesh, pos, held, target)
    assert not found.late
    np.testing.assert_array_equal(found.pos[held], target[held])
    assert len(self_crossings(found.pos, faces)) == 0
    assert _free_way(mesh, pos, found.pos)


@pytest.mark.parametrize("down", [0.012, 0.05])
def test_layers_that_are_held_on_both_sides_stop_before_they_meet(down: float) -> None:
    mesh, pos, faces = _sheets()
    held = _held(_MIDDLE, _MIDDLE + _SIZE)
    target = pos.copy()
    target[_MIDDLE + _SIZE] -= [0.0, down, 0.0]
    assert len(self_crossings(np.where(held[:, None], target, pos), faces)) > 0
    found = _follow(mesh, pos, held, target)
    assert found.late
    assert not found.lag[~held].any()
    np.testing.assert_allclose(found.lag[held], np.linalg.norm(found.pos - target, axis=1)[held])
    assert len(self_crossings(found.pos, faces)) == 0
    assert _free_way(mesh, pos, found.pos)
    # The one is as much in the way of the other: each gives half of it, and no more than has to be.
    assert down / 2 - 0.006 < found.lag[_MIDDLE].mean() < down / 2
    assert found.lag[_MIDDLE + _SIZE].mean() == pytest.approx(found.lag[_MIDDLE].mean(), rel=0.05)


def test_only_those_stop_that_cloth_is_in_the_way_of() -> None:
    mesh, pos, _ = _sheets()
    corner = np.array([0, 1, 7])
    held = _held(corner, _MIDDLE, _MIDDLE + _SIZE)
    target = pos.copy()
    target[_MIDDLE + _SIZE] -= [0.0, 0.02, 0.0]
    target[corner] -= [0.0, 0.0, 0.01]
    found = _follow(mesh, pos, held, target)
    assert (found.lag[_MIDDLE] > 1e-3).all()
    assert not found.lag[corner].any()


@pytest.mark.parametrize("rows", [_MIDDLE, np.arange(7)], ids=["patch", "line"])
def test_as_one_body_nothing_is_in_the_way(rows: np.ndarray) -> None:
    """Layers a hundredth of a millimetre apart that are turned by 20 degrees and carried half a metre, held anywhere."""
    mesh, pos, faces = _sheets(gap=1e-5)
    held = _held(rows, rows + _SIZE)
    angle = np.radians(20.0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    target = pos @ turn.T + [0.5, 0.1, -0.2]
    found = _follow(mesh, pos, held, target)
    assert not found.late
    np.testing.assert_array_equal(found.pos[held], target[held])
    assert len(self_crossings(found.pos, faces)) == 0


def test_nothing_is_searched_for_where_all_is_apart_and_little_changes() -> None:
    mesh, pos, _ = _sheets()
    held = _held(_MIDDLE, _MIDDLE + _SIZE)
    ClothSurface(mesh, pos, held, 20.0).remember_apart(pos)
    target = pos + [0.0, 0.3, 0.0]
    target[_MIDDLE] += 2e-4
    found = _follow(mesh, pos, held, target)
    assert found.seconds == 0.0
    assert _free_way(mesh, pos, found.pos)
    target[_MIDDLE] += 2e-2
    assert _follow(mesh, pos, held, target).seconds > 0.0
