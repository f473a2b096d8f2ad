"""Cloth near cloth: the list of pairs, and moves on which nothing meets."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from hood.mesh import cloth_proximity, topology
from hood.mesh.cloth_proximity import ClothSurface, LayerMesh
from hood.mesh.penetration.crossing import self_crossings
from hood.testing import grid

pytestmark = pytest.mark.usefixtures("compiled_layers")


def _sheets(n: int = 8) -> tuple[LayerMesh, np.ndarray, np.ndarray]:
    pos, faces = grid(n, n, 0.3)
    rest, both = np.concatenate([pos, pos + [0.011, 0.01, 0.007]]), np.concatenate([faces, faces + len(pos)])
    return LayerMesh(rest, both, 3e-3), rest, both


def _layers(mesh: LayerMesh, pos: np.ndarray, fixed: np.ndarray | None = None) -> ClothSurface:
    return ClothSurface(mesh, pos, np.zeros(len(pos), bool) if fixed is None else fixed, pressure=20.0)


def _pairs(layers: ClothSurface, pos: np.ndarray) -> set[tuple[int, ...]]:
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


def _to_segments(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances of points to segments, all (N, 3)."""
    along = b - a
    share = np.clip(((p - a) * along).sum(1) / (along * along).sum(1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(p - a - share[:, None] * along, axis=1))


def _all_pairs(mesh: LayerMesh, faces: np.ndarray, pos: np.ndarray) -> dict[tuple[int, ...], float]:
    """Distances of all pairs of features without a common vertex by (whether edges, corners): no boxes, no bounds."""
    vertex, face = (axis.reshape(-1) for axis in np.meshgrid(np.arange(len(pos)), np.arange(len(faces)), indexing="ij"))
    corners = np.column_stack([vertex, faces[face]])
    corners = corners[(corners[:, :1] != corners[:, 1:]).all(1)]
    p, a, b, c = (pos[corners[:, k]] for k in range(4))
    dist = np.minimum(np.minimum(_to_segments(p, a, b), _to_segments(p, b, c)), _to_segments(p, c, a))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = ((p - a) * normal).sum(1)
    foot = p - height[:, None] * normal
    ways = [(np.cross(second - first, foot - first) * normal).sum(1) for first, second in ((a, b), (b, c), (c, a))]
    dist = np.where((np.array(ways) >= 0.0).all(0), np.abs(height), dist)
    found = {(0, *pair): far for pair, far in zip(corners.tolist(), dist.tolist(), strict=True)}
    edges = topology.unique_edges(faces)
    one, two = np.triu_indices(len(edges), 1)
    corners = np.column_stack([edges[one], edges[two]])
    corners = corners[(corners[:, :2, None] != corners[:, None, 2:]).all((1, 2))]
    a, b, c, d = (pos[corners[:, k]] for k in range(4))
    ends = ((a, c, d), (b, c, d), (c, a, b), (d, a, b))
    dist = np.minimum.reduce([_to_segments(*end) for end in ends])
    # Between the ends the distance of the lines, where its foot is on both.
    u, v, w = b - a, d - c, a - c
    uu, uv, vv, uw, vw = ((x * y).sum(1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = uu * vv - uv * uv
    sound = det > 1e-12 * uu * vv
    s, t = (np.where(sound, share, -1.0) / np.where(sound, det, 1.0) for share in (uv * vw - vv * uw, uu * vw - uv * uw))
    between = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    dist = np.where(between, np.minimum(dist, np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1)), dist)
    return found | {(1, *pair): far for pair, far in zip(corners.tolist(), dist.tolist(), strict=True)}


def _require_all_pairs(layers: ClothSurface, faces: np.ndarray, pos: np.ndarray) -> int:
    """Check what is in reach against all pairs; how many are."""
    reach = layers.mesh.reach
    everything = _all_pairs(layers.mesh, faces, pos)
    near = {pair for pair, dist in everything.items() if dist < reach[list(pair[1:])].min() - 1e-9}
    nearly = {pair for pair, dist in everything.items() if dist < reach[list(pair[1:])].min() + 1e-9}
    found = layers.contacts(pos)
    listed = [(int(edges), *row) for edges, row in zip(found.edges, found.corners.tolist(), strict=True)]
    assert len(listed) == len(set(listed))
    assert near <= set(listed) <= nearly
    gap = np.linalg.norm((found.weights[:, :, None] * pos[found.corners]).sum(1), axis=1)
    np.testing.assert_allclose(gap, [everything[pair] for pair in listed], atol=1e-9)
    return len(listed)


def test_pairs_in_reach_are_those_of_all_pairs_at_random_and_crushed() -> None:
    mesh, pos, faces = _sheets(6)
    rng = np.random.default_rng(4)
    counts = []
    for squeeze in (1.0, 0.3, 0.05, 0.02):
        here = pos * np.array([squeeze, 0.3, squeeze]) + 1e-3 * rng.normal(size=pos.shape)
        counts.append(_require_all_pairs(_layers(mesh, pos), faces, here))
    assert counts[0] < counts[-1]
    assert counts[-1] > 1000


@pytest.mark.parametrize("squeeze", [1.0, 0.3, 0.05])
def test_what_is_found_and_its_order_do_not_depend_on_the_threads(squeeze: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of pairs in reach, of pairs of faces that are crossed at the start, and of a way that is limited."""
    mesh, pos, _ = _sheets(12)
    rng = np.random.default_rng(7)
    here = pos * np.array([squeeze, 0.3, squeeze]) + 2e-3 * rng.normal(size=pos.shape)
    there = here + 5e-3 * rng.normal(size=pos.shape)
    found = []
    for threads in (1, 2, 5, 64):
        monkeypatch.setattr(cloth_proximity, "num_parts", lambda count, least, threads=threads: threads)
        layers = _layers(mesh, here)
        contacts, crossed = layers.contacts(here), layers.crossed
        arrays = contacts.corners, contacts.edges, contacts.weights
        found.append((*arrays, crossed, layers.limit(here, there), layers.contacts(there).corners, layers.work.listed))
    assert len(found[0][0]) > 20
    assert squeeze > 0.1 or found[0][-4] > 0
    for others in found[1:]:
        for one, other in zip(found[0], others, strict=True):
            assert np.array_equal(one, other)


_TORN = """
import resource, sys
import numpy as np
from hood.mesh import cloth_proximity
from hood.testing import grid
cloth_proximity.num_parts = lambda count, least: int(sys.argv[1])
pos, faces = grid(45, 45, 0.4)
mesh, torn = cloth_proximity.LayerMesh(pos, faces, 3e-3), 1e-4 * np.random.default_rng(0).normal(size=pos.shape)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
layers = cloth_proximity.ClothSurface(mesh, torn, np.zeros(len(pos), bool), pressure=20.0)
print(layers.crossed, *layers.work[:2], layers.work.overflowed, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.parametrize("threads", ["1", "16"])
def test_cloth_where_all_is_near_all_is_told_of_and_takes_no_more_memory_with_many_threads(threads: str) -> None:
    run = subprocess.run([sys.executable, "-c", _TORN, threads], capture_output=True, text=True, check=True, timeout=300)
    *found, kilobytes = run.stdout.split()
    assert found == ["0", "0", "0", "True"]
    assert int(kilobytes) < 500_000


def test_parallel_edges_are_as_far_apart_as_their_ends_say() -> None:
    """Of edges whose directions are the same but for rounding: shares from their nearly singular equations are no answer."""
    rng = np.random.default_rng(6)
    for count in range(30, 40):
        start = 0.3 * np.arange(count)[:, None] * np.eye(3)[0] + 0.05 * rng.normal(size=(count, 3))
        along, aside, tip, scale, shift = (rng.normal(size=(count, k)) for k in (3, 3, 3, 1, 1))
        along, aside = 0.02 * along, 1e-3 * aside
        other = start + aside + 0.5 * shift * along
        pos = np.concatenate([start, start + along, start + 0.05 * tip, other, other + scale * along, other - 0.05 * tip])
        faces = np.arange(6 * count).reshape(6, count).T.reshape(-1, 3)
        mesh = LayerMesh(pos, faces, 3e-3)
        assert _require_all_pairs(_layers(mesh, pos), faces, pos) > 10


def test_pairs_in_reach_are_those_of_all_pairs_whatever_was_asked_before() -> None:
    """Ways ahead, moves of all cloth and of few vertices, limits and energies in between: the list is never short of a pair."""
    mesh, pos, faces = _sheets(6)
    rng = np.random.default_rng(5)
    here = pos * np.array([0.5, 0.3, 0.5])
    ahead = here + [0.03, 0.0, 0.0] + 2e-3 * rng.normal(size=pos.shape)
    layers = ClothSurface(mesh, here, np.zeros(len(pos), bool), 20.0, ahead=ahead)
    fresh = 0
    for turn in range(16):
        there = here + 0.02 * rng.normal(size=3) + 4e-4 * rng.normal(size=pos.shape)
        there[rng.integers(len(pos))] += 0.01 * rng.normal(size=3)
        there = ahead + 1e-3 * rng.normal(size=pos.shape) if turn == 0 else there
        share = layers.limit(here, there)
        assert share == pytest.approx(_layers(mesh, here).limit(here, there), rel=1e-9)
        fresh += _require_all_pairs(layers, faces, here + share * (there - here))
        if turn % 3 == 0:
            assert layers.energy(there) == pytest.approx(_layers(mesh, here).energy(there), rel=1e-9)
        here = here + share * (there - here)
    assert fresh > 0
    assert layers.work.refreshes > 3
    assert layers.work.searches < 10


def test_common_motion_needs_no_search() -> None:
    mesh, pos, _ = _sheets()
    near = pos * np.array([1.0, 0.2, 1.0])
    layers = _layers(mesh, near)
    first = layers.energy(near)
    assert first > 0.0
    for step in range(1, 5):
        assert layers.energy(near + 0.1 * step) == pytest.approx(first, rel=1e-9)
    assert layers.work.searches == 1
    assert layers.work.refreshes == 0


def test_where_cloth_is_known_to_be_apart_no_search_is_made() -> None:
    mesh, pos, _ = _sheets()
    first = _layers(mesh, pos)
    assert first.limit(pos, pos + 0.001) == 1.0
    first.remember_apart(pos + 0.001)
    again = _layers(mesh, pos + 0.2)
    assert again.crossed == len(again.contacts(pos + 0.2).corners) == again.work.searches == 0
    near = pos * np.array([1.0, 0.2, 1.0])
    assert len(again.contacts(near).corners) > 0
    again.remember_apart(near)
    assert mesh.apart is not None
    np.testing.assert_array_equal(mesh.apart.pos, pos + 0.001)
    others = [
        _layers(mesh, near),
        _layers(mesh, pos, np.ones(len(pos), bool)),
        ClothSurface(mesh, pos, np.zeros(len(pos), bool), 1.0, True),
    ]
    for other in others:
        other.contacts(pos)
        assert other.work.searches == 1


def test_a_free_way_is_told_as_from_the_list() -> None:
    """Sheets shifted towards, through and along each other, from where they are known to be apart and not."""
    mesh, pos, _ = _sheets()
    rng, answers = np.random.default_rng(8), []
    for turn in range(60):
        _layers(mesh, pos).remember_apart(pos)
        there = pos + 1e-3 * rng.normal(size=pos.shape)
        there[len(pos) // 2 :] += [0.002 * turn, -0.0004 * turn, 0.0]
        known, listed = _layers(mesh, pos), _layers(mesh, pos)
        assert known.crossed == known.work.searches == 0
        mesh.apart = None
        fresh = _layers(mesh, pos)
        assert fresh.crossed == 0
        found = known.free_way(pos, there)
        assert found == fresh.free_way(pos, there)
        assert found[0] == (listed.limit(pos, there) == 1.0 and not len(listed.contacts(there).corners))
        answers.append(found[0])
    assert 10 < sum(answers) < 50


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


def test_features_that_slide_past_each_other_are_not_held_up() -> None:
    """Two edges a ten-millionth of a millimetre apart that go past each other by a centimetre, and apart by as little; then
    a little towards each other."""
    pos = 0.01 * np.array([[-2, 0, 0], [2, 0, 0], [0, -2, -3], [0, 0, -2], [0, 0, 2], [3, 2, 0]])
    mesh = LayerMesh(pos + 0.5 * np.eye(3)[1] * np.arange(2).repeat(3)[:, None], np.array([[0, 1, 2], [3, 4, 5]]), 3e-3)
    pos[3:, 1] += 1e-10
    past = pos.copy()
    past[3:] += [0.009, 1e-10, 0.004]
    assert _layers(mesh, pos).limit(pos, past) == 1.0
    past[3:, 1] -= 1e-6
    share = _layers(mesh, pos).limit(pos, past)
    assert 0.0 < share < 1e-4
    ways = [pos + part * share * (past - pos) for part in np.linspace(0.0, 1.0, 101)]
    sides = {np.sign(np.linalg.det([x[1] - x[0], x[4] - x[3], x[3] - x[0]])) for x in ways}
    assert len(sides) == 1


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


def _visited(num_faces: int) -> list[tuple[int, int]]:
    """Pairs of places in the order in which the tree visits faces: halves down to four, each in itself, then both."""

    def within(begin: int, end: int) -> list[tuple[int, int]]:
        if end - begin <= 4:
            return [(i, j) for i in range(begin, end) for j in range(i + 1, end)]
        middle = (begin + end) // 2
        return within(begin, middle) + within(middle, end) + between((begin, middle), (middle, end))

    def between(a: tuple[int, int], b: tuple[int, int]) -> list[tuple[int, int]]:
        one, other = a[1] - a[0], b[1] - b[0]
        if max(one, other) <= 4:
            return [(i, j) for i in range(*a) for j in range(*b)]
        if other <= 4 or (one > 4 and one >= other):
            middle = sum(a) // 2
            return between((a[0], middle), b) + between((middle, a[1]), b)
        middle = sum(b) // 2
        return between(a, (b[0], middle)) + between(a, (middle, b[1]))

    return within(0, num_faces)


def test_sums_run_in_the_order_of_the_tree_however_a_pair_was_found() -> None:
    """Pairs of faces with a common vertex are known beforehand; sums over all pairs keep their order, and so their bits."""
    mesh, pos, _ = _sheets(7)
    crumpled = 0.3 * pos + 6e-3 * np.random.default_rng(5).normal(size=pos.shape)
    found = _layers(mesh, pos).contacts(crumpled)
    place = np.argsort(mesh._arrays["order"])
    of_vertex, of_edge = (
        {int(one): int(place[face]) for face, row in enumerate(mesh._arrays[name]) for one in row if one >= 0}
        for name in ("face_vertex", "face_edge")
    )
    faces = {tuple(sorted(face)): int(place[number]) for number, face in enumerate(mesh._arrays["faces"].tolist())}
    edges = {tuple(sorted(edge)): of_edge[number] for number, edge in enumerate(mesh._arrays["edges"].tolist())}
    rank = {pair: number for number, pair in enumerate(_visited(len(faces)))}
    corners = [tuple(row) for row in found.corners.tolist()]
    both = [
        (edges[tuple(sorted(row[:2]))], edges[tuple(sorted(row[2:]))])
        if of_edges
        else (of_vertex[row[0]], faces[tuple(sorted(row[1:]))])
        for row, of_edges in zip(corners, found.edges, strict=True)
    ]
    ranks = np.array([rank[min(pair), max(pair)] for pair in both])
    numbers = {number: set(face) for face, number in faces.items()}
    beside = np.array([bool(numbers[a] & numbers[b]) for a, b in both])
    for kind in (found.edges, ~found.edges):
        assert beside[kind].any()
        assert not beside[kind].all()
        assert (np.diff(ranks[kind]) >= 0).all()


def _fan(count: int, more: int) -> tuple[LayerMesh, np.ndarray]:
    """Triangles around one vertex, so many on a disc that is folded once, and more below it."""
    turn = np.linspace(0.0, 1.8 * np.pi, count + 1)
    disc = np.stack([np.cos(turn), 0.0 * turn, np.sin(turn)], axis=1)
    below = np.stack([0.2 * np.arange(more + 1.0), np.full(more + 1, -1.0), np.zeros(more + 1)], axis=1)
    rest = np.concatenate([np.zeros((1, 3)), disc, below])
    first = np.concatenate([np.arange(1, count + 1), np.arange(count + 2, count + more + 2)])
    folded = rest.copy()
    folded[1 : count + 2] = np.where(disc[:, :1] < 0.0, disc * [-1.0, 1.0, 1.0] + [0.0, 2e-3, 0.0], disc)
    return LayerMesh(rest, np.stack([0 * first, first, first + 1], axis=1), 3e-3), folded


def test_a_vertex_of_very_many_faces_has_the_same_pairs() -> None:
    """Pairs of faces with a common vertex are known beforehand, but where these are as many as the square of 65 and more."""
    (few, folded), (many, both) = _fan(60, 0), _fan(60, 10)
    ours = {row for row in _pairs(_layers(few, folded), folded)}
    theirs = {row for row in _pairs(_layers(many, both), both) if max(row) < len(folded)}
    assert len(ours) > 20
    assert {frozenset(row) for row in ours} == {frozenset(row) for row in theirs}


def test_pairs_are_asked_for_again_where_positions_changed_in_place() -> None:
    mesh, pos, _ = _sheets()
    layers, here = _layers(mesh, pos), pos.copy()
    assert len(layers.contacts(here).corners) == 0
    here[len(pos) // 2 :, 1] -= 0.008
    assert _pairs(layers, here) == _pairs(_layers(mesh, pos), here) != set()
