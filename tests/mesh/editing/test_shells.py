"""Layers of thick cloth are found, and nothing else is taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.editing.shells import find_shell, paired_sheet, same_sheet
from hood.testing import cylinder, grid

THICKEST = 0.012


def thick_tube(thickness: float) -> tuple[np.ndarray, np.ndarray, int]:
    """A closed tube with walls; its outer faces come first."""
    pos, faces = cylinder(24, 6, 0.1, 0.2)
    inner = pos * [1.0 - thickness / 0.1, 1.0, 1.0 - thickness / 0.1]
    count = len(pos)
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, back, times = np.unique(np.sort(half, axis=1) @ [count, 1], return_inverse=True, return_counts=True)
    a, b = half[times[back] == 1].T
    rims = [np.stack([b, a, a + count], axis=1), np.stack([b, a + count, b + count], axis=1)]
    return np.concatenate([pos, inner]), np.concatenate([faces, faces[:, ::-1] + count, *rims]), len(faces)


@pytest.mark.parametrize("thickness", [5e-4, 2e-3, 5e-3, 1e-2])
@pytest.mark.parametrize("turned", [False, True])
def test_a_tube_with_walls_has_two_layers(thickness: float, turned: bool) -> None:
    pos, faces, count = thick_tube(thickness)
    shell = find_shell(pos, faces[:, ::-1] if turned else faces, THICKEST)
    assert shell is not None
    assert np.array_equal(shell.outer, np.arange(count))
    assert np.array_equal(shell.inner, np.arange(count, 2 * count))
    assert shell.thickness == pytest.approx(thickness, rel=0.02)


def test_moved_turned_and_renumbered_it_has_the_same_layers() -> None:
    pos, faces, count = thick_tube(2e-3)
    rng = np.random.default_rng(0)
    turn, order, mixed = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.permutation(len(pos)), rng.permutation(len(faces))
    place = np.empty_like(pos)
    place[order] = pos @ turn.T + 3.0
    shell = find_shell(place, order[faces][mixed], THICKEST)
    assert shell is not None
    assert set(mixed[shell.outer].tolist()) == set(range(count))


@pytest.mark.parametrize("thickness", [0.02, 0.05])
def test_what_is_thicker_than_cloth_is_none(thickness: float) -> None:
    assert find_shell(*thick_tube(thickness)[:2], THICKEST) is None


def test_a_sheet_that_lies_on_another_corner_on_corner_is_the_same() -> None:
    pos, faces = grid(5, 4)
    both = np.concatenate([pos, pos + 1e-9])
    assert same_sheet(both, faces, faces[:, ::-1] + len(pos), 1e-6)
    assert same_sheet(both, faces, faces[3:9] + len(pos), 1e-6)
    assert not same_sheet(np.concatenate([pos, pos + 1e-3]), faces, faces + len(pos), 1e-6)


def test_two_sheets_of_one_make_are_paired_and_others_are_not() -> None:
    pos, faces = grid(5, 4)
    both = np.concatenate([pos, pos + [0.0, 0.0, 2e-3]])
    assert paired_sheet(both, faces, faces[::-1] + len(pos), THICKEST) == pytest.approx(2e-3)
    assert paired_sheet(both, faces, faces[:-1] + len(pos), THICKEST) is None
    assert paired_sheet(np.concatenate([pos, pos + [0.0, 0.0, 0.05]]), faces, faces + len(pos), THICKEST) is None
    other = faces.copy()
    other[0] = [0, 1, 19]
    assert paired_sheet(both, faces, other + len(pos), THICKEST) is None
