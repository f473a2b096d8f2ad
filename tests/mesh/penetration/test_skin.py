"""How far skin sticks out through cloth: a ball through patches of known place, bare skin beside a hem, nearest points."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.penetration.crossing import crossings
from hood.mesh.penetration.exposure import EXPOSURE_REACH, closest_on_triangles, skin_depth, sunken
from hood.mesh.topology import unique_edges
from hood.testing import grid, random_rotation, sphere

pytestmark = pytest.mark.usefixtures("form")

RADIUS = 0.1


def ball_with_a_top() -> tuple[np.ndarray, np.ndarray]:
    """A ball around the origin with a vertex at its highest point (0, 0, RADIUS)."""
    pos, faces = sphere(4, RADIUS)
    up = pos[0] / RADIUS
    side = np.cross(up, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    return pos @ np.stack([side, np.cross(up, side), up]).T, faces


BALL, BALL_FACES = ball_with_a_top()


def sheet(cells: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """A flat square in the plane z = 0 around the origin."""
    pos, faces = grid(cells + 1, cells + 1, size)
    pos = pos - pos.mean(axis=0)
    flat = np.ptp(pos, axis=0).argmin()
    return pos[:, [axis for axis in range(3) if axis != flat] + [flat]], faces


def depth(pos: np.ndarray, faces: np.ndarray, ball: np.ndarray, ball_faces: np.ndarray = BALL_FACES) -> float:
    return skin_depth(pos, faces, ball, ball_faces, crossings(pos, faces, ball, ball_faces))


@pytest.mark.parametrize("cells", [3, 17, 60])
@pytest.mark.parametrize("height", [0.002, 0.02, 0.06])
def test_a_ball_through_a_patch_sticks_out_by_its_cap(cells: int, height: float) -> None:
    """With triangles larger and smaller than the cap; turned over and moved the cloth gives the same."""
    pos, faces = sheet(cells, 0.5)
    ball = BALL + [0.013, 0.007, height - RADIUS]
    assert depth(pos, faces, ball) == pytest.approx(height, abs=1e-9)
    assert depth(pos, faces[:, ::-1], ball) == pytest.approx(height, abs=1e-9)
    turn, shift = random_rotation(np.random.default_rng(0)), np.array([3.0, -2.0, 1.0])
    assert depth(pos @ turn.T + shift, faces, ball @ turn.T + shift) == pytest.approx(height, abs=1e-9)


def test_skin_under_the_cloth_is_not_above_it() -> None:
    pos, faces = sheet(20, 0.5)
    assert depth(pos, faces, BALL - [0, 0, RADIUS + 1e-3]) == 0.0
    assert depth(pos, faces, BALL - [0, 0, 5.0]) == 0.0


def test_skin_beside_a_hem_is_bare() -> None:
    """A ball of which half is covered: beyond the rim the skin is higher than the cloth and sticks out through nothing."""
    pos, faces = sheet(20, 0.2)
    beside = BALL + [0.12, 0.003, -0.04]  # its highest point is beyond the rim
    cut = crossings(pos, faces, beside, BALL_FACES)
    assert len(cut.pairs) > 0
    found = skin_depth(pos, faces, beside, BALL_FACES, cut)
    over_cloth = beside[:, 0] < 0.1
    assert 0.03 < found <= beside[over_cloth, 2].max() + 1e-9
    assert found < beside[:, 2].max() - 1e-3
    hung = pos @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) + [0.0, 0.0, 0.1]  # upright, its hem at z = 0
    stands = BALL + [0.0, 0.004, -RADIUS - 1e-3]
    assert depth(hung, faces, stands) == 0.0


def test_skin_under_another_layer_is_that_layers() -> None:
    """Where a whole layer lies over the cap, the layer below is still cut, and only it counts as long as it is nearer."""
    pos, faces = sheet(17, 0.5)
    ball = BALL + [0.013, 0.007, 0.02 - RADIUS]
    both = np.concatenate([pos, pos + [0, 0, 0.025]]), np.concatenate([faces, faces + len(pos)])
    found = depth(*both, ball)
    assert 0.010 < found < 0.0127  # above half of 25 mm the upper layer is nearer


def test_what_is_too_far_is_not_looked_for() -> None:
    pos, faces = sheet(40, 1.0)
    big = 3 * BALL + [0.013, 0.007, 0.12 - 3 * RADIUS]
    assert EXPOSURE_REACH - 0.02 < depth(pos, faces, big) <= EXPOSURE_REACH * (1 + 1e-6)


def test_the_far_side_of_the_body_does_not_stick_out() -> None:
    """Through a plate 3 cm thick cloth passes 1 cm under one side and 2 cm under the other: the shorter way out counts."""
    pos, faces = sheet(40, 0.5)
    plate = BALL * [1.0, 1.0, 0.15] + [0.013, 0.007, 0.01 - 0.015]
    assert depth(pos, faces, plate) == pytest.approx(0.01, abs=1e-9)


def test_vertices_under_the_skin() -> None:
    pos, faces = sheet(40, 0.5)
    ball = BALL + [0.013, 0.007, 0.04 - RADIUS]
    inside = np.linalg.norm(pos - [0.013, 0.007, 0.04 - RADIUS], axis=1)
    found = sunken(pos, unique_edges(faces), ball, BALL_FACES, crossings(pos, faces, ball, BALL_FACES))
    assert found.sum() > 20
    assert found[inside < 0.995 * RADIUS].all()
    assert not found[inside > RADIUS].any()


def test_nearest_points_of_triangles() -> None:
    """No point of the triangle is nearer, and the weights are those of the point."""
    rng = np.random.default_rng(1)
    corners = rng.normal(size=(200, 3, 3))
    corners[0, 2] = corners[0, 1]
    corners[1, 2] = 0.5 * corners[1, 0] + 0.5 * corners[1, 1]
    corners[2] = corners[2, 0]
    points = rng.normal(size=(200, 3))
    points[:50] = 0.2 * corners[:50].mean(axis=1) + 0.1 * points[:50]
    nearest, weights = closest_on_triangles(points, corners)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.einsum("ni,nij->nj", weights, corners), nearest)
    dist = np.linalg.norm(points - nearest, axis=1)
    for share in rng.dirichlet(np.full(3, 0.5), 500):
        assert (np.linalg.norm(points - np.einsum("i,nij->nj", share, corners), axis=1) > dist - 1e-12).all()
    assert {int(count) for count in (weights == 0).sum(axis=1)} == {0, 1, 2}
