"""Triangles that pass through each other: known cases, all pairs one by one, and what must not matter."""

from __future__ import annotations

import numpy as np
import pytest

from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.testing import cylinder, grid, random_rotation, sphere

pytestmark = pytest.mark.usefixtures("form")

FLAT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FACE = np.array([[0, 1, 2]])


def cross(first: np.ndarray, second: np.ndarray) -> bool:
    return len(crossings(first, FACE, second, FACE).pairs) == 1


def patch(cells: int, size: float, centre: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of triangles, upright on the z axis of its normal."""
    step = np.linspace(-size / 2, size / 2, cells + 1)
    x, y = np.meshgrid(step, step, indexing="ij")
    pos = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) + centre
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    a, b, c, d = corner, corner + cells + 1, corner + cells + 2, corner + 1
    return pos, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def soup(rng: np.random.Generator, count: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of their own corners, thrown into the unit cube."""
    pos = rng.uniform(0, 1, (count, 1, 3)) + rng.uniform(-size, size, (count, 3, 3))
    return pos.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def exact_pairs(pos: np.ndarray, faces: np.ndarray, other_pos: np.ndarray, other_faces: np.ndarray) -> np.ndarray:
    """The rule of the module, for whole numbers and all pairs: nothing is rounded."""
    a, b = pos[faces][:, None], other_pos[other_faces][None]
    side = [_volume(b[..., 0, :], b[..., 1, :], b[..., 2, :], a[..., corner, :]) for corner in range(3)]
    other_side = [_volume(a[..., 0, :], a[..., 1, :], a[..., 2, :], b[..., corner, :]) for corner in range(3)]
    straddle = np.ones((len(faces), len(other_faces)), dtype=bool)
    for s in (side, other_side):
        straddle &= (np.min(s, axis=0) < 0) & (np.max(s, axis=0) > 0)
    passes = np.zeros_like(straddle)
    for s, t, height in ((a, b, side), (b, a, other_side)):
        for i, j in ((0, 1), (1, 2), (2, 0)):
            p, q = s[..., i, :], s[..., j, :]
            turns = [_volume(p, q, t[..., u, :], t[..., v, :]) for u, v in ((0, 1), (1, 2), (2, 0))]
            inside = (np.min(turns, axis=0) >= 0) | (np.max(turns, axis=0) <= 0)
            passes |= (np.sign(height[i]) * np.sign(height[j]) < 0) & inside
    return np.argwhere(straddle & passes)


def _volume(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    return ((b - a) * np.cross(c - a, d - a)).sum(axis=-1)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ([[0.2, 0.2, -1], [0.3, 0.2, 1], [0.2, 0.3, 1]], True),  # two edges through the middle
        ([[0.2, 0.2, -1], [0.2, 0.2, 1], [5, 5, 1]], True),  # one edge through it
        ([[-1, 0.3, -1], [-1, 0.3, 1], [3, 0.3, 0]], True),  # cut right through: edges of the flat one pass
        ([[2, 2, -1], [2, 2, 1], [3, 3, 0]], False),  # beside it, boxes apart
        ([[0.9, 0.9, -1], [0.9, 0.9, 1], [0.95, 0.95, 0]], False),  # boxes overlap
        ([[0.2, 0.2, 1e-6], [0.3, 0.2, 1], [0.2, 0.3, 1]], False),  # just above
        ([[0.2, 0.2, -1e-6], [0.3, 0.2, 1], [0.2, 0.3, 1]], True),  # just below
        ([[0.2, 0.2, 0], [0.3, 0.2, 1], [0.2, 0.3, 1]], False),  # a corner touches
        ([[0.2, 0.2, 0], [0.4, 0.2, 0], [0.2, 0.3, 1]], False),  # an edge lies in the plane
        ([[0.1, 0.1, 0], [0.5, 0.1, 0], [0.1, 0.5, 0]], False),  # one plane
        ([[0.2, 0.2, -1], [0.2, 0.2, 1], [0.2, 0.2, 0.5]], False),  # no area
        ([[0.0, 0.5, -1], [0.0, 0.5, 1], [-1, 0.5, 0]], True),  # an edge through the rim
        ([[0.25, 0.25, 0], [0.5, 0.5, 1], [0.5, 0.5, -1]], True),  # a corner in the plane, the opposite edge on the rim
    ],
)
def test_known_pairs(other: list[list[float]], expected: bool) -> None:
    assert cross(FLAT, np.array(other)) is expected
    assert cross(np.array(other), FLAT) is expected


def test_the_edges_that_pass_through_are_named() -> None:
    second = np.array([[0.2, 0.2, -1], [0.3, 0.2, 1], [0.2, 0.3, 1]])
    found = crossings(FLAT, np.array([[2, 0, 1]]), second, np.array([[1, 2, 0]]))
    assert found.first_edges.tolist() == []
    assert found.second_edges.tolist() == [[0, 1, 0], [0, 2, 0]]


def test_a_sphere_through_a_patch_is_cut_along_its_circle() -> None:
    """Cut faces of the patch are those that hold a point of the circle; none has the circle wholly inside or outside."""
    pos, faces = patch(20, 2.0, (0.013, 0.007, 0.0))
    ball, ball_faces = sphere(3, 0.6)
    found = crossings(pos, faces, ball + [0, 0, -0.25], ball_faces)
    radius = np.sqrt(0.6**2 - 0.25**2)
    corners = np.linalg.norm(pos[faces][..., :2], axis=2)
    centres = np.linalg.norm(pos[faces].mean(axis=1)[:, :2], axis=1)
    cut = np.zeros(len(faces), dtype=bool)
    cut[found.pairs[:, 0]] = True
    certain = (corners.min(axis=1) < radius - 0.01) & (corners.max(axis=1) > radius + 0.01)
    assert certain.sum() > 20
    assert cut[certain].all()
    assert np.abs(centres[cut] - radius).max() < 0.1
    inside = np.linalg.norm(pos[:, :2], axis=1) < radius
    assert all(inside[a] != inside[b] for a, b in np.unique(found.first_edges[:, :2], axis=0))


@pytest.mark.parametrize(("seed", "most"), [(0, 4), (1, 6), (2, 10), (3, 1000)])
def test_every_pair_is_decided_as_in_whole_numbers(seed: int, most: int) -> None:
    """On a coarse lattice most pairs are special: corners in planes, edges through edges, triangles without area."""
    rng = np.random.default_rng(seed)
    pos, other_pos = (rng.integers(0, most + 1, (3 * count, 3)) for count in (80, 90))
    faces, other_faces = (np.arange(3 * count).reshape(-1, 3) for count in (80, 90))
    expected = exact_pairs(pos, faces, other_pos, other_faces)
    assert len(expected) > 300
    np.testing.assert_array_equal(crossings(pos, faces, other_pos, other_faces).pairs, expected)
    within = exact_pairs(pos, faces, pos, faces)
    np.testing.assert_array_equal(self_crossings(pos, faces), within[within[:, 0] < within[:, 1]])


def test_nothing_slips_between_faces() -> None:
    """Edges that meet a mesh exactly in its edges pass through it: a patch through the lines of another one."""
    pos, faces = patch(4, 1.0, (0, 0, 0))
    upright = pos[:, [2, 0, 1]] + [0.1, 0.0, 0.1]
    found = crossings(pos, faces, upright, faces)
    # Five upright lines, each through a line of the patch or its rim, and a diagonal between two of them.
    assert len(np.unique(found.second_edges[:, :2], axis=0)) == 9


def test_motion_winding_order_and_roles_change_nothing() -> None:
    rng = np.random.default_rng(7)
    (pos, faces), (other_pos, other_faces) = soup(rng, 150, 0.2), soup(rng, 160, 0.2)
    plain = crossings(pos, faces, other_pos, other_faces)
    turn, shift = random_rotation(rng), np.array([100.0, -30.0, 7.0])
    moved = crossings(pos @ turn.T + shift, faces, other_pos @ turn.T + shift, other_faces)
    for one, other in zip(plain, moved, strict=True):
        np.testing.assert_array_equal(one, other)
    wound = crossings(pos, faces[:, [1, 0, 2]], other_pos, other_faces[:, [2, 0, 1]])
    np.testing.assert_array_equal(plain.pairs, wound.pairs)
    swapped = crossings(other_pos, other_faces, pos, faces)
    assert set(map(tuple, swapped.pairs[:, ::-1].tolist())) == set(map(tuple, plain.pairs.tolist()))
    np.testing.assert_array_equal(swapped.first_edges, plain.second_edges)
    order = rng.permutation(len(pos))  # new number of every vertex
    renamed = np.empty_like(pos)
    renamed[order] = pos
    again = crossings(renamed, order[faces], other_pos, other_faces)
    np.testing.assert_array_equal(plain.pairs, again.pairs)
    back = np.argsort(order)
    edges = np.unique(np.column_stack([np.sort(back[again.first_edges[:, :2]], axis=1), again.first_edges[:, 2]]), axis=0)
    np.testing.assert_array_equal(edges, plain.first_edges)


def test_scale_does_not_matter() -> None:
    rng = np.random.default_rng(8)
    (pos, faces), (other_pos, other_faces) = soup(rng, 80, 0.2), soup(rng, 80, 0.2)
    plain = crossings(pos, faces, other_pos, other_faces).pairs
    for scale in (1e-6, 1e6):
        np.testing.assert_array_equal(plain, crossings(scale * pos, faces, scale * other_pos, other_faces).pairs)


def test_smooth_meshes_do_not_cross_themselves() -> None:
    for pos, faces in (sphere(2), cylinder(24, 12), grid(12, 12)):
        assert len(self_crossings(pos, faces)) == 0


def test_a_strip_through_itself_is_found_and_neighbours_are_left_out() -> None:
    """A band that is led in a loop and back through itself crosses along one line; faces with a common vertex do not count."""
    turn = np.linspace(-2.0, 2.0, 81)
    path = np.column_stack([turn**3 - 2 * turn, turn**2])  # crosses itself at (0, 2)
    pos = np.concatenate([np.column_stack([path, np.full(81, z)]) for z in (0.0, 0.1)])
    first = np.arange(80)
    faces = np.concatenate([np.column_stack([first, first + 1, first + 82]), np.column_stack([first, first + 82, first + 81])])
    pairs = self_crossings(pos, faces)
    assert len(pairs) > 0
    middle = pos[faces].mean(axis=1)[pairs]
    assert np.abs(middle[..., 0]).max() < 0.15
    assert np.abs(middle[..., 1] - 2.0).max() < 0.3
    folded = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, -0.5, 0.5], [0.5, 0.9, -0.5]])
    assert len(self_crossings(folded, np.array([[0, 1, 2], [0, 3, 4]]))) == 0
    apart = np.concatenate([folded, [[0.01, 0.005, 0.001]]])
    assert len(self_crossings(apart, np.array([[0, 1, 2], [5, 3, 4]]))) == 1


def test_triangles_that_are_not_finite_cross_nothing() -> None:
    rng = np.random.default_rng(9)
    (pos, faces), (other_pos, other_faces) = soup(rng, 50, 0.3), soup(rng, 50, 0.3)
    plain = crossings(pos, faces, other_pos, other_faces).pairs
    broken = pos.copy()
    broken[0], broken[4, 1] = np.nan, np.inf
    with np.errstate(all="raise"):
        found = crossings(broken, faces, other_pos, other_faces).pairs
        np.testing.assert_array_equal(found, plain[plain[:, 0] > 1])
        assert len(crossings(np.full_like(pos, np.nan), faces, other_pos, other_faces).pairs) == 0
        assert len(self_crossings(np.full_like(pos, np.inf), faces)) == 0


def test_nothing_to_compare() -> None:
    none = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    assert all(len(rows) == 0 for rows in crossings(FLAT, FACE, *none))
    assert all(len(rows) == 0 for rows in crossings(*none, FLAT, FACE))
    assert len(self_crossings(*none)) == 0
