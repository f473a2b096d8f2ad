"""Rims that lie along each other, as those of pattern pieces that belong together: which vertices and edges face each other.

Open edges cut by new vertices: the faces behind them become fans, and everything that corners carry is divided alike.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree


class Cut(NamedTuple):
    """A mesh with new vertices on open edges."""

    faces: np.ndarray  # (F′, 3), the uncut faces first
    parent: np.ndarray  # (F′,) the face that each is of
    corners: np.ndarray  # (F′, 3) rows of ``sources``: where each corner of the new faces comes from
    sources: np.ndarray  # (S, 2) corners of the old faces, as face · 3 + corner; twice the same for one that was there
    at: np.ndarray  # (S,) 0 to 1, from the first to the second
    ends: np.ndarray  # (N, 2) vertices that each new vertex lies between, in the order of the cuts
    share: np.ndarray  # (N,) 0 to 1, from the first to the second


def cut_edges(faces: np.ndarray, num_vertices: int, face: np.ndarray, corner: np.ndarray, at: np.ndarray) -> Cut:
    """``faces`` (F, 3) with the vertex ``num_vertices`` + n on the edge of ``face[n]`` from its ``corner[n]`` on, at the
    share ``at[n]`` of it. No two faces share one of these edges."""
    following = (corner + 1) % 3
    ends = np.stack([faces[face, corner], faces[face, following]], axis=1)
    old = np.arange(faces.size)
    sources = np.concatenate([np.stack([old, old], axis=1), np.stack([3 * face + corner, 3 * face + following], axis=1)])
    shares = np.concatenate([np.zeros(faces.size), at])
    whole = np.setdiff1d(np.arange(len(faces)), face)
    tables, parents = [old.reshape(-1, 3)[whole]], [whole]
    for one in np.unique(face).tolist():
        fan = _fan(one, [np.flatnonzero((face == one) & (corner == k)) for k in range(3)], at, faces.size)
        tables.append(fan)
        parents.append(np.full(len(fan), one))
    corners = np.concatenate(tables)
    vertex = np.concatenate([faces.reshape(-1), num_vertices + np.arange(len(face))])
    return Cut(vertex[corners], np.concatenate(parents), corners, sources, shares, ends, at)


def _fan(face: int, on_edges: list[np.ndarray], at: np.ndarray, count: int) -> np.ndarray:
    """Triangles (n, 3) of sources that a face with vertices on its edges is cut into: a polygon whose ears are cut off where
    they are no slivers."""
    polygon: list[int] = []
    side: list[set[int]] = []
    for k, rows in enumerate(on_edges):
        polygon.append(3 * face + k)
        side.append({k, (k - 1) % 3})
        for row in rows[np.argsort(at[rows])]:
            polygon.append(count + int(row))
            side.append({k})
    triangles = []
    while len(polygon) > 3:
        ear = next(n for n in range(len(polygon)) if _is_ear(side, n))
        triangles.append([polygon[ear - 1], polygon[ear], polygon[(ear + 1) % len(polygon)]])
        del polygon[ear], side[ear]
    return np.array([*triangles, polygon], dtype=np.int64)


def _is_ear(side: list[set[int]], n: int) -> bool:
    """Whether a corner of a polygon and its neighbours lie on no one side of the triangle, nor what is left without it."""
    return not (side[n - 1] & side[n] & side[(n + 1) % len(side)] or set.intersection(*side[:n], *side[n + 1 :]))


def along(cut: Cut, values: np.ndarray) -> np.ndarray:
    """Values (V, …) of vertices with those of the new ones behind them, linear along their edges."""
    share = cut.share.reshape(-1, *[1] * (values.ndim - 1))
    new = (1.0 - share) * values[cut.ends[:, 0]] + share * values[cut.ends[:, 1]]
    return np.concatenate([values, new.astype(values.dtype)])


def along_corners(cut: Cut, table: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (F′, 3) into values (U′, n), from corners (F, 3) into values (U, n): such as texture coordinates."""
    flat, added = table.reshape(-1), len(cut.sources) - table.size
    first, second = flat[cut.sources[table.size :]].T
    share = cut.at[table.size :, None]
    number = np.concatenate([flat, len(values) + np.arange(added)])
    return number[cut.corners], np.concatenate([values, (1.0 - share) * values[first] + share * values[second]])


#: A seam is at least so long [m] and has so many vertices on either side: corners of two pieces may meet by chance.
_SHORTEST, _FEWEST = 0.03, 3
#: A vertex that faces an edge within this share of its length from an end is sewn to that end.
_NEAR_END = 0.3
#: Edges are cut no nearer than this share to their ends, and not for what faces an end [share]; and two vertices that are less
#: apart along a rim than this [m] face each other.
_LEAST, _AT_END, _SAME = 0.15, 0.05, 1e-9
#: Two parts end in front of each other where the cosine between their ways out is below the first, and neither rim lies farther
#: behind the other one than the second [m].
_OPPOSITE, _BEHIND = -0.4, 1e-3
#: Vertices of the same rim are no candidates for each other within so many times the gap along it.
_ALONG = 6.0


class Rims(NamedTuple):
    """The open edges of a mesh."""

    edges: np.ndarray  # (E, 2) vertices
    face: np.ndarray  # (E,) the one that each is of
    corner: np.ndarray  # (E,) the edge runs from this corner of the face to the next
    inner: np.ndarray  # (E,) the third vertex of the face

    @property
    def vertices(self) -> np.ndarray:
        """(n,) ascending."""
        return np.unique(self.edges)


class Seam(NamedTuple):
    """Two parts whose rims lie along each other, or one with itself."""

    parts: tuple[int, int]
    length: float  # m
    gap: float  # m, median distance
    share: float  # of the shorter of the two whole rims
    in_front: float  # share of it where each part ends in front of the other, not over it


class Facing(NamedTuple):
    """What is to be sewn."""

    seams: list[Seam]
    pairs: np.ndarray  # (N, 2) vertices that are to be one
    cut: np.ndarray  # (M, 2) a vertex that faces the inside of an edge, and the row of that edge among the rims
    at: np.ndarray  # (M,) where on the edge, 0 to 1


def find_rims(faces: np.ndarray) -> Rims:
    """Edges that belong to exactly one face, in the direction in which that has them."""
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    key = np.sort(half, axis=1) @ np.array([int(half.max(initial=0)) + 1, 1])
    _, first, times = np.unique(key, return_index=True, return_counts=True)
    rows = np.sort(first[times == 1])
    return Rims(half[rows], rows // 3, rows % 3, faces.reshape(-1)[rows - rows % 3 + (rows + 2) % 3])


def ways_out(pos: np.ndarray, rims: Rims) -> np.ndarray:
    """(V, 3) unit vectors: the way out of the mesh ``pos`` (V, 3) across its rim; zero at vertices that are not on it."""
    length = np.linalg.norm(pos[rims.edges[:, 1]] - pos[rims.edges[:, 0]], axis=1)
    total = np.zeros_like(pos)
    np.add.at(total, rims.edges, (length[:, None] * _across(pos, rims))[:, None])
    return _unit(total)


def _across(pos: np.ndarray, rims: Rims) -> np.ndarray:
    """(E, 3) unit vectors: the way out across every open edge, upright on it in the plane of its face."""
    start, end = pos[rims.edges[:, 0]], pos[rims.edges[:, 1]]
    along, out = _unit(end - start), start - pos[rims.inner]
    return _unit(out - (out * along).sum(axis=1, keepdims=True) * along)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))


def find_facing(
    pos: np.ndarray,
    rims: Rims,
    part: np.ndarray,
    gap: float,
    sewn: Callable[[Seam], bool],
    own: bool = True,
    left_out: np.ndarray | None = None,
) -> Facing:
    """Which rims of ``pos`` (V, 3) [m] lie within ``gap`` [m] of each other.

    Args:
        part: (V,) part that a vertex is of.
        sewn: whether a seam that was found is to be sewn.
        own: whether a part may be sewn to itself.
        left_out: vertices (n,) that are sewn to nothing.
    """
    matches = _closest(pos, rims, part, gap, own)
    if left_out is not None and len(left_out):
        ends = np.concatenate([matches.vertex[:, None], rims.edges[matches.edge]], axis=1)
        matches = _Matches(*(column[~np.isin(ends, left_out).any(axis=1)] for column in matches))
    seams, kept = _seams(pos, rims, part, matches, sewn)
    matches = _Matches(*(column[kept] for column in matches))
    pairs = _mutual(pos, rims, part, matches)
    done = _keys(pairs.reshape(-1), part[pairs[:, ::-1].reshape(-1)])
    end = rims.edges[matches.edge, (matches.at > 0.5).astype(np.int64)]
    left = ~np.isin(_keys(matches.vertex, part[end]), done)
    near = left & (np.minimum(matches.at, 1.0 - matches.at) < _NEAR_END) & ~np.isin(_keys(end, part[matches.vertex]), done)
    pairs = np.concatenate([pairs, np.stack([matches.vertex[near], end[near]], axis=1)])
    cut = left & ~near & (np.minimum(matches.at, 1.0 - matches.at) > _AT_END)
    rows = np.stack([matches.vertex[cut], matches.edge[cut]], axis=1)
    return Facing(seams, pairs, rows, np.clip(matches.at[cut], _LEAST, 1.0 - _LEAST))


class _Matches(NamedTuple):
    """The open edge of every part that is nearest to a vertex of a rim."""

    vertex: np.ndarray
    edge: np.ndarray  # row
    at: np.ndarray  # place on it, 0 to 1
    dist: np.ndarray  # m


def _closest(pos: np.ndarray, rims: Rims, part: np.ndarray, gap: float, own: bool) -> _Matches:
    vertices = rims.vertices
    start, end = pos[rims.edges[:, 0]], pos[rims.edges[:, 1]]
    length = np.linalg.norm(end - start, axis=1)
    middles = cKDTree(0.5 * (start + end))
    found = middles.query_ball_point(pos[vertices], gap + 0.5 * float(length.max(initial=0.0)))
    row = np.repeat(np.arange(len(vertices)), [len(one) for one in found])
    edge = np.concatenate([np.zeros(0), *found]).astype(np.int64)
    point, way = pos[vertices[row]], end[edge] - start[edge]
    at = np.clip(((point - start[edge]) * way).sum(axis=1) / np.maximum(length[edge] ** 2, 1e-30), 0.0, 1.0)
    dist = np.linalg.norm(start[edge] + at[:, None] * way - point, axis=1)
    other = part[rims.edges[edge, 0]] != part[vertices[row]]
    if own:
        along = _along(pos, rims, vertices)
        here, there = along[0][vertices[row]], along[0][rims.edges[edge, 0]]
        way_between = np.abs(here - there)
        same_loop = along[1][vertices[row]] == along[1][rims.edges[edge, 0]]
        around = np.minimum(way_between, along[2][vertices[row]] - way_between)
        other |= ~same_loop | (around > _ALONG * gap + 2.0 * length[edge])
    good = other & (dist <= gap) & (rims.edges[edge] != vertices[row][:, None]).all(axis=1)
    row, edge, at, dist = (column[good] for column in (row, edge, at, dist))
    key = _keys(row, part[rims.edges[edge, 0]])
    order = np.lexsort((dist, key))
    first = order[np.unique(key[order], return_index=True)[1]]
    return _Matches(vertices[row[first]], edge[first], at[first], dist[first])


def _along(pos: np.ndarray, rims: Rims, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every vertex of a rim: how far along it is, which loop it is of, and how long that is; (V,) each."""
    place, loop_of, whole = np.zeros(len(pos)), np.full(len(pos), -1), np.full(len(pos), np.inf)
    after = dict(zip(rims.edges[:, 0].tolist(), rims.edges[:, 1].tolist(), strict=True))
    for number, begin in enumerate(vertices.tolist()):
        if loop_of[begin] >= 0 or begin not in after:
            continue
        loop, vertex = [], begin
        while vertex in after and loop_of[vertex] < 0:
            loop_of[vertex] = number
            loop.append(vertex)
            vertex = after[vertex]
        steps = np.linalg.norm(pos[loop] - np.roll(pos[loop], -1, axis=0), axis=1)
        place[loop] = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
        whole[loop] = steps.sum()
    return place, loop_of, whole


def _seams(
    pos: np.ndarray, rims: Rims, part: np.ndarray, matches: _Matches, sewn: Callable[[Seam], bool]
) -> tuple[list[Seam], np.ndarray]:
    """The seams that are sewn, and which matches (N,) bool are of them."""
    here, there = part[matches.vertex], part[rims.edges[matches.edge, 0]]
    key = np.stack([np.minimum(here, there), np.maximum(here, there)], axis=1)
    start, end = pos[rims.edges[:, 0]], pos[rims.edges[:, 1]]
    length = np.linalg.norm(end - start, axis=1)
    share_of_vertex = np.zeros(len(pos))
    for side in (0, 1):
        np.add.at(share_of_vertex, rims.edges[:, side], 0.5 * length)
    whole = np.bincount(part[rims.edges[:, 0]], weights=length, minlength=int(part.max(initial=0)) + 1)
    in_front = _in_front(pos, rims, matches)
    kept, seams = np.zeros(len(key), dtype=bool), []
    for one, other in np.unique(key, axis=0).tolist():
        rows = (key == (one, other)).all(axis=1)
        sides = [share_of_vertex[matches.vertex[rows & (here == side)]] for side in {one, other}]
        run = float(np.mean([side.sum() for side in sides])) / (2.0 if one == other else 1.0)
        enough = all(len(side) >= _FEWEST for side in sides) and run >= _SHORTEST
        if not enough:
            continue
        ahead = float(np.average(in_front[rows], weights=share_of_vertex[matches.vertex[rows]]))
        share = run / float(min(whole[one], whole[other]))
        if sewn(seam := Seam((one, other), run, float(np.median(matches.dist[rows])), share, ahead)):
            seams.append(seam)
            kept |= rows
    return seams, kept


def _in_front(pos: np.ndarray, rims: Rims, matches: _Matches) -> np.ndarray:
    """(N,) bool: whether the part of a matched vertex and that of its edge end in front of each other there. In a corner the
    vertex has that one of its two edges which is more opposite."""
    across, rows = _across(pos, rims), np.arange(len(rims.edges))
    of_vertex = np.zeros((len(pos), 2), dtype=np.int64)
    of_vertex[rims.edges] = rows[:, None, None]  # of a vertex that two edges begin or end at there is one of them
    of_vertex[rims.edges[:, 0], 0], of_vertex[rims.edges[:, 1], 1] = rows, rows
    facing = across[matches.edge]
    both = across[of_vertex[matches.vertex]]
    cosines = np.einsum("nki,ni->nk", both, facing)
    own = both[np.arange(len(both)), cosines.argmin(axis=1)]
    first, second = pos[rims.edges[matches.edge]].transpose(1, 0, 2)
    between = first + matches.at[:, None] * (second - first) - pos[matches.vertex]
    depth = np.minimum((own * between).sum(axis=1), -(facing * between).sum(axis=1))
    return np.asarray((cosines.min(axis=1) < _OPPOSITE) & (depth >= -_BEHIND))


def _mutual(pos: np.ndarray, rims: Rims, part: np.ndarray, matches: _Matches) -> np.ndarray:
    """Pairs (N, 2) of matched vertices each of which is the nearer end of the edge that the other one faces."""
    end = rims.edges[matches.edge, (matches.at > 0.5).astype(np.int64)]
    length = np.linalg.norm(pos[rims.edges[matches.edge, 1]] - pos[rims.edges[matches.edge, 0]], axis=1)
    beside = np.minimum(matches.at, 1.0 - matches.at) * length  # m along the rim between the two
    faced = {(int(v), int(part[e])): int(e) for v, e in zip(matches.vertex, end, strict=True)}
    taken: dict[tuple[int, int], tuple[float, int]] = {}  # of several that face one vertex from one part the nearest one
    for vertex, other, off in zip(matches.vertex.tolist(), end.tolist(), beside.tolist(), strict=True):
        own = int(part[vertex])
        if faced.get((other, own)) == vertex or off < _SAME:
            taken[other, own] = min(taken.get((other, own), (np.inf, -1)), (off, vertex))
    pairs = {tuple(sorted((vertex, other))) for (other, _), (_, vertex) in taken.items()}
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _keys(vertex: np.ndarray, part: np.ndarray) -> np.ndarray:
    """One number for a vertex and a part."""
    return vertex.astype(np.int64) * (1 << 20) + part
