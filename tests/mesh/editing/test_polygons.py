"""Polygons become triangles that cover the same area with the same winding."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.editing.quality import newell_normal, triangulate


def areas(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed areas of triangles in the plane z = 0."""
    a, b, c = (pos[faces[:, k], :2] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def polygon(points: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pos = np.array([(*point, 0.0) for point in points])
    return pos, np.arange(len(pos)), np.array([len(pos)])


SHAPES = {
    "square": [(0, 0), (1, 0), (1, 1), (0, 1)],
    "arrow": [(0, 0), (2, 1), (0, 2), (0.5, 1)],  # concave at the last corner
    "arrow turned": [(0.5, 1), (0, 0), (2, 1), (0, 2)],
    "comb": [(0, 0), (5, 0), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)],
    "star": [
        (np.cos(t) * r, np.sin(t) * r) for t, r in zip(np.linspace(0, 2 * np.pi, 10, endpoint=False), [2, 0.6] * 5, strict=True)
    ],
    "with a straight corner": [(0, 0), (1, 0), (2, 0), (2, 1), (0, 1)],
}


@pytest.mark.parametrize("name", SHAPES)
def test_area_and_winding_are_kept(name: str) -> None:
    pos, corners, counts = polygon(SHAPES[name])
    rows = triangulate(pos, corners, counts)
    assert rows.shape == (len(pos) - 2, 3)
    area = areas(pos, corners[rows])
    assert (area >= 0).all()
    assert area.sum() == pytest.approx(0.5 * np.linalg.norm(newell_normal(pos)))


def test_quads_take_the_shorter_diagonal() -> None:
    pos, corners, counts = polygon([(0, 0), (4, 0), (5, 1), (1, 1)])
    rows = triangulate(pos, corners, counts)
    edges = {tuple(sorted(pair)) for row in rows.tolist() for pair in zip(row, row[1:] + row[:1], strict=True)}
    assert (1, 3) in edges
    assert (0, 2) not in edges


def test_mixed_table_keeps_the_order_of_the_polygons() -> None:
    """Triangle, quad, pentagon, triangle: corners are found again by polygon."""
    rng = np.random.default_rng(0)
    counts = np.array([3, 4, 5, 3])
    pos = np.concatenate([np.stack([np.cos(a), np.sin(a), 0.01 * rng.normal(size=len(a))], 1) for a in map(ring, counts)])
    rows = triangulate(pos, np.arange(counts.sum()), counts)
    owner = np.repeat(np.arange(4), counts)[rows]
    np.testing.assert_array_equal(owner[:, 0], np.repeat(np.arange(4), counts - 2))
    assert (owner == owner[:, :1]).all()


def ring(count: int) -> np.ndarray:
    return np.arange(count) * 2 * np.pi / count


def test_relabelled_corners_follow() -> None:
    """The corner table is looked up, so any vertex numbers work."""
    pos, corners, counts = polygon(SHAPES["comb"])
    order = np.random.default_rng(1).permutation(len(pos))
    moved = np.empty_like(pos)
    moved[order] = pos
    rows = triangulate(moved, order[corners], counts)
    np.testing.assert_array_equal(rows, triangulate(pos, corners, counts))


def test_a_bent_quad_is_not_folded() -> None:
    """One corner lifted out of the plane: both halves face the quad's side."""
    pos = np.array([[0, 0, 0], [1, 0, 0.4], [1, 1, 0], [0.1, 0.9, 0.5]])
    faces = np.arange(4)[triangulate(pos, np.arange(4), np.array([4]))]
    corner = pos[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    assert (cross @ newell_normal(pos) > 0).all()
