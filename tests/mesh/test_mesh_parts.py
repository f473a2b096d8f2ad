"""How many edges of a body go through an opening."""

from __future__ import annotations

import numpy as np

from hood.mesh.parts import num_through
from hood.mesh.topology import unique_edges


def test_edges_through_an_opening_are_counted_as_by_volumes() -> None:
    """An edge goes through a triangle where its ends are on both sides and it passes the three sides the same way round."""
    rng = np.random.default_rng(3)
    angle = np.arange(9) * 2 * np.pi / 9
    ring = np.stack([0.3 * np.sin(angle), np.zeros(9), 0.3 * np.cos(angle)], axis=1)
    rim = ring + rng.normal(0, 0.02, (9, 3))
    points = rng.uniform(-0.4, 0.4, (60, 3))
    edges = unique_edges(rng.integers(0, 60, (200, 3)))
    middle, expected = rim.mean(axis=0), 0
    for start, end in points[edges]:
        through = False
        for first, second in zip(rim, np.roll(rim, -1, axis=0), strict=True):
            corners = [middle, first, second]
            sides = [np.linalg.det(np.stack([b - a for b in (*corners[1:], p)])) for p in (start, end) for a in [corners[0]]]
            around = [np.linalg.det(np.stack([end - start, corners[k] - start, corners[k - 2] - start])) for k in range(3)]
            through |= bool(np.prod(np.sign(sides)) < 0 and abs(np.sign(around).sum()) == 3)
        expected += through
    assert expected > 20
    assert num_through(rim, points, edges) == expected
