"""Cloth near cloth: the list of pairs, and moves on which nothing meets."""

from __future__ import annotations

import numpy as np

from hood.mesh.crossing import self_crossings
from hood.mesh.layers import LayerMesh, Layers
from hood.testing import grid


def _sheets(n: int = 8) -> tuple[LayerMesh, np.ndarray, np.ndarray]:
    pos, faces = grid(n, n, 0.3)
    rest, both = np.concatenate([pos, pos + [0.011, 0.01, 0.007]]), np.concatenate([faces, faces + len(pos)])
    return LayerMesh(rest, both, 3e-3), rest, both


def _layers(mesh: LayerMesh, pos: np.ndarray, fixed: np.ndarray | None = None) -> Layers:
    return Layers(mesh, pos, np.zeros(len(pos), bool) if fixed is None else fixed, pressure=20.0)


def _pairs(layers: Layers, pos: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(row) for row in layers.contacts(pos).corners.tolist()}


def _distance(corners: np.ndarray, edges: bool) -> float:
    """Smallest distance between points of two features, (4, 3), over a fine grid of both."""
    share = np.linspace(0.0, 1.0, 61)
    if edges:
        first = corners[0] + share[:, None] * (corners[1] - corners[0])
        second = corners[2] + share[:, None] * (corners[3] - corners[2])
    else:
        a, b = (axis.reshape(-1) for axis in np.meshgrid(share, share))
        inside = a + b <= 1.0 + 1e-12
        first = corners[:1]
        second = corners[1] + a[inside, None] * (corners[2] - corners[1]) + b[inside, None] * (corners[3] - corners[1])
    return float(np.linalg.norm(first[:, None] - second[None], axis=2).min())


def test_gap_is_the_distance_of_the_features() -> None:
    mesh, pos, _ = _sheets()
    rng = np.random.default_rng(0)
    near = pos + 1e-3 * rng.normal(size=pos.shape)
    near[len(pos) // 2 :, 1] -= 0.008
    found = _layers(mesh, pos).contacts(near)
    assert found.edges.any()
    assert not found.edges.all()
    for row in range(0, len(found.corners), 7):
        corners = near[found.corners[row]]
        gap = float(np.linalg.norm(found.weights[row] @ corners))
        dense = _distance(corners, bool(found.edges[row]))
        assert gap <= dense + 1e-12
        assert dense - gap < 1e-3
        assert gap < found.reach[row]


def test_list_is_complete_wherever_vertices_went() -> None:
    mesh, pos, _ = _sheets()
    rng = np.random.default_rng(1)
    layers, here = _layers(mesh, pos), pos
    for _ in range(6):
        here = here + 0.004 * rng.normal(size=pos.shape)
        assert _pairs(layers, here) == _pairs(_layers(mesh, pos), here)


def test_limited_moves_cross_nothing() -> None:
    mesh, pos, faces = _sheets()
    rng = np.random.default_rng(2)
    layers, here = _layers(mesh, pos), pos
    crossed = 0
    for _ in range(30):
        there = here + 0.01 * rng.normal(size=pos.shape)
        crossed += len(self_crossings(there, faces))
        share = layers.limit(here, there)
        assert 0.0 < share <= 1.0
        here = here + share * (there - here)
        assert len(self_crossings(here, faces)) == 0
    assert crossed > 0


def test_moving_together_is_free() -> None:
    mesh, pos, _ = _sheets()
    assert _layers(mesh, pos).limit(pos, pos + [0.5, -0.3, 0.2]) == 1.0


def test_approach_gets_near_without_crossing() -> None:
    mesh, pos, faces = _sheets()
    target = pos.copy()
    target[len(pos) // 2 :, 1] -= 0.04 * np.random.default_rng(3).random(len(pos) // 2)
    layers = _layers(mesh, pos)
    reached = layers.approach(target)
    assert len(self_crossings(target, faces)) > 0
    assert len(self_crossings(reached, faces)) == 0
    assert layers.limit(pos, reached) == 1.0
    free = pos + [0.0, 0.01, 0.0]
    np.testing.assert_array_equal(_layers(mesh, pos).approach(free), free)


def test_held_vertices_go_where_they_must_and_are_counted() -> None:
    mesh, pos, _ = _sheets()
    fixed = np.ones(len(pos), bool)
    fixed[0] = False
    target = pos.copy()
    target[len(pos) // 2 :, 1] -= 0.03
    layers = _layers(mesh, pos, fixed)
    reached = layers.approach(target)
    np.testing.assert_array_equal(reached[fixed], target[fixed])
    assert layers.forced > 0


def test_what_is_crossed_at_the_start_is_left_out() -> None:
    mesh, pos, faces = _sheets()
    through = pos.copy()
    through[len(pos) // 2 :, 1] -= 0.02 * (pos[len(pos) // 2 :, 0] > 0.15)
    layers = _layers(mesh, through)
    assert layers.crossed == len(self_crossings(through, faces)) > 0
    assert layers.work.left_out > 0
    assert _layers(mesh, pos).crossed == 0


def test_positions_that_are_not_finite_end_the_search() -> None:
    mesh, pos, _ = _sheets()
    broken = pos.copy()
    broken[3] = np.nan
    layers = _layers(mesh, broken)
    assert len(layers.contacts(broken).corners) == 0
    assert layers.work.overflowed
