"""A garment put on: outside the body, with the lengths that it was made with as far as the body lets it."""

from __future__ import annotations

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.garment.binding import PosedBody, posed_body, push_out, signed_distances
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence_edit import arms_down
from hood.mesh import topology
from hood.scene.worn import STRETCHED, put_on
from hood.testing import sphere


def test_settling_spreads_what_pushing_out_stretches(garments: dict[str, Garment], body: Body) -> None:
    """Shorts that are 5% too small: pushed out vertex by vertex edges get 10% longer, worn half of that."""
    shorts, posed = garments["shorts"], posed_body(body, arms_down(0.0), 0, np.zeros(10))
    middle = shorts.rest_pos.mean(axis=0)
    small = Garment(
        "small", middle + 0.95 * (shorts.rest_pos - middle), shorts.faces, np.zeros(len(shorts.rest_pos), dtype=bool)
    )
    pushed = push_out(small.rest_pos, posed.surface, posed.faces, 2e-3)
    worn = put_on(small, pushed.pos, posed, 2e-3)
    edges = topology.unique_edges(small.faces)
    pushed_ratio, worn_ratio = (_lengths(pos, edges) / _lengths(small.rest_pos, edges) for pos in (pushed.pos, worn.pos))
    assert pushed.num_inside > 20
    assert worn_ratio.max() - 1 < 0.75 * (pushed_ratio.max() - 1)
    assert worn.stretch_max == pytest.approx(worn_ratio.max() - 1)
    assert worn.compression_max == pytest.approx(1 - worn_ratio.min())
    assert worn.stretched_share == 0.0
    assert signed_distances(worn.pos, posed.surface, posed.faces).min() > 1e-3


def test_cloth_that_cannot_reach_around_the_body_is_counted() -> None:
    """A bag around a ball, smaller than that by a quarter: every edge is too long."""
    surface, faces = sphere(3, radius=0.4)
    count = len(surface)
    ball = Body("ball", surface, np.zeros((count, 3, 0)), np.zeros((1, count)), np.ones((count, 1)), (-1,), faces)
    pos, triangles = sphere(1, radius=0.3)
    bag = Garment("bag", pos, triangles, np.zeros(len(pos), dtype=bool))
    worn = put_on(bag, 1.4 * pos, PosedBody(ball, np.zeros(0), surface, np.eye(4)[None, :3]), 2e-3)
    edges = topology.unique_edges(triangles)
    stretch = _lengths(worn.pos, edges) / _lengths(pos, edges) - 1
    assert worn.stretched_share == pytest.approx((stretch > STRETCHED).mean())
    assert worn.stretched_share > 0.9
    assert worn.stretch_max == pytest.approx(stretch.max())
    assert signed_distances(worn.pos, surface, faces).min() > 1e-3


def _lengths(pos: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1))
