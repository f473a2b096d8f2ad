"""Riders follow the cloth rigidly, and survive what happens to its vertices."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hood.mesh.parts import Riders, clusters, find_parts, join_riders, rigid_anchors
from hood.testing import cylinder, grid


def on_a_sheet() -> tuple[np.ndarray, Riders]:
    pos, _ = grid(5, 5)
    ride = np.array([[0.1, 0.1, 0.02], [0.12, 0.1, 0.02], [0.1, 0.12, 0.03], [0.9, 0.9, 0.01]])
    return pos, Riders(
        ride, np.array([[0, 1, 2]]), np.array([0, 0, 0, 1]), np.array([0, 1, 5, 6, 24, 23, 19]), np.array([0, 0, 0, 0, 1, 1, 1])
    )


def test_riders_take_the_motion_of_the_cloth() -> None:
    pos, riders = on_a_sheet()
    np.testing.assert_allclose(riders.positions(pos, pos), riders.pos, atol=1e-12)
    turn, shift = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), np.array([3.0, 1.0, -2.0])
    np.testing.assert_allclose(riders.positions(pos @ turn.T + shift, pos), riders.pos @ turn.T + shift, atol=1e-12)


def test_a_group_keeps_its_shape_where_the_cloth_stretches() -> None:
    pos, riders = on_a_sheet()
    rng = np.random.default_rng(0)
    there = riders.positions(pos * [1.5, 1.0, 1.0] + 0.02 * rng.normal(size=pos.shape), pos)
    lengths = [np.linalg.norm(points[:3] - np.roll(points[:3], 1, axis=0), axis=1) for points in (riders.pos, there)]
    np.testing.assert_allclose(*lengths, atol=1e-12)


def test_cloth_that_is_not_finite_takes_its_own_riders_along() -> None:
    pos, riders = on_a_sheet()
    broken = pos.copy()
    broken[24] = np.nan
    there = riders.positions(broken, pos)
    assert np.isfinite(there[:3]).all()
    assert np.isnan(there[3]).all()


def test_renumbered_riders_follow_the_same_cloth() -> None:
    pos, riders = on_a_sheet()
    order = np.random.default_rng(1).permutation(len(pos))
    moved = riders.renumbered(order)
    assert moved is not None
    place = np.empty_like(pos)
    place[order] = pos
    np.testing.assert_allclose(moved.positions(place * 2.0, place), riders.positions(pos * 2.0, pos))
    gone = np.arange(len(pos))
    gone[[0, 1, 5, 6]] = -1
    left = riders.renumbered(gone)
    assert left is not None
    assert (len(left.pos), left.num_groups, len(left.faces)) == (1, 1, 0)
    assert riders.renumbered(np.full(len(pos), -1)) is None


def test_riders_of_joined_cloths_each_follow_their_own() -> None:
    pos, riders = on_a_sheet()
    both = join_riders([None, riders, riders], [0, 10, 40], [0, 0, 0])
    assert both is not None
    assert both.num_groups == 4
    assert both.first_anchor.tolist() == [10, 10, 10, 34, 40, 40, 40, 64]


def test_a_thing_follows_the_cloth_around_it() -> None:
    pos, _ = grid(21, 21, 0.2)
    middle = pos[220]
    anchors = rigid_anchors(np.stack([middle, middle + 5e-3]), pos, np.array([0, 1, 2]))
    assert {0, 1, 2, 220} <= set(anchors.tolist())
    assert np.linalg.norm(pos[anchors[3:]] - middle, axis=1).max() < 0.02


def test_things_that_touch_are_one() -> None:
    points = [np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[1.0005, 0, 0]]), np.array([[2.0, 0, 0]])]
    assert clusters(points, 1e-3).tolist() == [0, 0, 1]


def test_parts_know_their_rims_and_whether_they_can_be_put_on() -> None:
    tube, faces = cylinder(8, 3, 0.1, 0.1)
    sheet, table = grid(4, 4)
    found = find_parts(np.concatenate([tube, sheet + 5.0, [[9.0, 9, 9]]]), np.concatenate([faces, table + len(tube)]))
    assert [(part.number, len(part.rims), part.can_be_put_on, part.closed) for part in found] == [
        (1, 2, True, False), (2, 1, False, False),
    ]  # fmt: skip
    np.testing.assert_allclose(found[1].low, sheet.min(axis=0) + 5.0)
