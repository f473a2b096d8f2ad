"""The search for overlapping boxes against comparing all of them."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.penetration import boxes
from hood.mesh.penetration.boxes import overlapping_boxes


def every_pair(low: np.ndarray, high: np.ndarray, other_low: np.ndarray, other_high: np.ndarray) -> np.ndarray:
    overlap = (low[:, None] <= other_high[None]) & (high[:, None] >= other_low[None])
    return np.argwhere(overlap.all(axis=2))


def found(*corners: np.ndarray) -> np.ndarray:
    """All blocks together, sorted; fails where a pair comes twice."""
    pairs = np.concatenate([np.empty((0, 2), dtype=np.int64), *overlapping_boxes(*corners)])
    result = np.unique(pairs, axis=0)
    assert len(result) == len(pairs)
    return result


def random_boxes(rng: np.random.Generator, count: int, sizes: tuple[float, float], shift: float = 0.0) -> list[np.ndarray]:
    """Boxes in the unit cube whose edges spread evenly over the logarithm of their lengths."""
    low = rng.uniform(0, 1, (count, 3)) + shift
    return [low, low + np.exp(rng.uniform(*np.log(sizes), (count, 3)))]


@pytest.mark.parametrize("sizes", [(0.02, 0.05), (1e-4, 1.0), (0.9, 1.0)])
@pytest.mark.parametrize("others", [(0.02, 0.05), (1e-3, 2.0)])
def test_the_pairs_are_those_of_comparing_all(sizes: tuple[float, float], others: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    corners = [*random_boxes(rng, 300, sizes), *random_boxes(rng, 400, others, 0.3)]
    expected = every_pair(*corners)
    assert len(expected) > 10
    np.testing.assert_array_equal(found(*corners), expected)


def test_boxes_of_many_cells_among_small_ones_and_small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boxes, "_BLOCK", 100)
    monkeypatch.setattr(boxes, "_MANY_CELLS", 20)
    rng = np.random.default_rng(4)
    groups = [
        np.concatenate(two) for two in zip(random_boxes(rng, 200, (0.01, 0.03)), random_boxes(rng, 5, (0.5, 2.0)), strict=True)
    ]
    others = [
        np.concatenate(two) for two in zip(random_boxes(rng, 300, (0.01, 0.03)), random_boxes(rng, 7, (0.5, 2.0)), strict=True)
    ]
    blocks = list(overlapping_boxes(*groups, *others))
    assert len(blocks) > 5
    np.testing.assert_array_equal(found(*groups, *others), every_pair(*groups, *others))


def test_points_touching_boxes_and_nothing_at_all() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(found(points, points, points, points), every_pair(points, points, points, points))
    unit = np.zeros((1, 3)), np.ones((1, 3))
    assert len(found(*unit, np.ones((1, 3)), np.full((1, 3), 2.0))) == 1  # a common corner
    assert len(found(*unit, np.full((1, 3), 1.1), np.full((1, 3), 2.0))) == 0
    none = np.empty((0, 3))
    assert len(found(none, none, *unit)) == len(found(*unit, none, none)) == 0
