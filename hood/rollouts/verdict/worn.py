"""Whether a garment stays where it was worn: each of its parts against the region of the body that it started on.

Four lengths say so, of every part that is worn in frame 0:

- *away*: how much farther its vertices are from their region of the body than they were from the body in frame 0, the median
  over the vertices that touched it there, and over the nearest of them for a part without an opening around a limb: a cape
  that is blown out hangs by its collar;
- *slipped*: how far the highest opening around a limb has moved along the body: the way of the middle of the points of the body
  that are nearest to its vertices, on the body of frame 0. An opening with no limb in it any more counts as a metre;
- *sunk*: how far its top has moved along the body towards where the feet are in frame 0, of a part with such an opening: a
  waistband, or that shoulder of a dress which has moved farther. Clothes slide up by more in a handstand, and stay on;
- *shifted*: how far its vertices that touched the body have moved along it, the median, of a part with such an opening: a dress
  that winds round the trunk keeps its neckline where it was.

The region of a vertex are the points of the body within 15 cm, along the skin, of its nearest one in frame 0; for the last
three lengths vertices are followed for 40 cm. Swinging hems, open jackets and crossed arms stay near their regions; trousers
around the ankles do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from hood.mesh.parts import num_through, rim_length
from hood.mesh.topology import boundary_loops, connected_components, unique_edges

#: A vertex nearer than this [m] to the body touches it; the region of a vertex reaches so far [m] along the skin, and openings
#: and tops are followed so far.
TOUCHES, _REGION, _FOLLOWED = 0.03, 0.15, 0.40
#: Of an opening, of a top, and of what touches the body, so many vertices are followed, at most.
_OF_OPENING, _OF_TOP, _OF_TOUCHING = 60, 30, 60
#: The top of a part is what touches the body so near [m] to its highest place that does: every connected piece of so many
#: vertices, at least.
_TOP, _LEAST_TOP = 0.06, 5
#: An opening lies around a limb where so many edges of the body go through it and this share of its vertices touches the body.
_THROUGH, _TIGHT = 6, 0.6
#: Shorter openings [m] are buttonholes and slits.
_LEAST_OPENING = 0.12
#: A part of which fewer vertices touch the body, and no limb goes through any opening, is not worn.
_LEAST_TOUCHING = 0.05
#: A part without an opening around a limb hangs by this share of what touches the body.
_HANGS = 0.02
#: Vertices of a part that are looked at, at most: their median is what is asked for.
_MOST_LOOKED_AT = 300
#: What an opening that has lost its limb has slipped by [m].
_LOST = 1.0
_NONE = np.zeros(0, dtype=np.int64)
#: Bodies with longer edges [m] get points between their vertices, so far apart, and so many at most.
_COARSE, _MOST_BETWEEN = 0.04, 20


@dataclass(frozen=True)
class Wear:
    """How far every part has got from where it was worn. NaN: the part is not worn in frame 0, or has no such opening."""

    frames: np.ndarray  # (S,) that were looked at
    away: np.ndarray  # (S, P) m
    slipped: np.ndarray  # (S, P) m
    sunk: np.ndarray  # (S, P) m
    shifted: np.ndarray  # (S, P) m
    num_vertices: np.ndarray  # (P,) of each part
    first_vertex: np.ndarray  # (P,) the lowest of each part
    gap: np.ndarray  # (P,) m, between part and body in frame 0


@dataclass(frozen=True)
class _Group:
    """Vertices of a part that touch the body, with the points of it around each."""

    vertices: np.ndarray  # (N,)
    region: np.ndarray  # (N, K) points of the body, the first repeated
    start: np.ndarray  # (N,) m, from the body in frame 0
    share: float  # of the vertices that are nearer than what is told

    def away(self, pos: np.ndarray, body: np.ndarray) -> float:
        """How much farther from their regions than in frame 0 its vertices are [m], at their ``share``."""
        dist_sq = _squares(pos[self.vertices], body, self.region).min(axis=1)
        return float(np.quantile(np.sqrt(dist_sq) - self.start, self.share))


@dataclass(frozen=True)
class _Followed:
    """Vertices, and where on the body of frame 0 they were."""

    vertices: np.ndarray  # (N,)
    region: np.ndarray  # (N, K) points of the body, the first of each nearest in frame 0
    places: np.ndarray  # (B, 3) m, points of the body in frame 0

    def ways(self, pos: np.ndarray, body: np.ndarray) -> np.ndarray:
        """(N, 3) m: how they have moved along the body, as on the body of frame 0."""
        near = _squares(pos[self.vertices], body, self.region).argmin(axis=1)
        now = self.places[self.region[np.arange(len(near)), near]]
        return np.asarray(now - self.places[self.region[:, 0]])


@dataclass(frozen=True)
class _Hold:
    """What a part is held by: its highest opening around a limb, the pieces of its top, and what touches the body."""

    rim: np.ndarray  # (R,) vertices along the opening
    opening: _Followed
    tops: list[_Followed]
    touching: _Followed

    def slipped(self, pos: np.ndarray, body: np.ndarray) -> float:
        """How far the opening has moved along the body [m]."""
        return float(np.linalg.norm(self.opening.ways(pos, body).mean(axis=0)))

    def sunk(self, pos: np.ndarray, body: np.ndarray) -> float:
        """How far that piece of the top has moved down the body which has moved farthest [m]; NaN without a top."""
        return max((-float(np.median(top.ways(pos, body)[:, 1])) for top in self.tops), default=np.nan)

    def shifted(self, pos: np.ndarray, body: np.ndarray) -> float:
        """How far what touches the body has moved along it [m]."""
        return float(np.median(np.linalg.norm(self.touching.ways(pos, body), axis=1)))


class WearMeter:
    """Measures frames of a garment that is worn by a body in the first of them.

    Args:
        pos: (V, 3) m, the cloth in frame 0.
        faces: (F, 3) of the cloth.
        body_pos: (W, 3) m, in frame 0.
        body_faces: (G, 3); at least one.
        pinned: (P,) vertices that are held: they count as touching the body.
    """

    def __init__(
        self,
        pos: np.ndarray,
        faces: np.ndarray,
        body_pos: np.ndarray,
        body_faces: np.ndarray,
        pinned: np.ndarray = _NONE,
    ) -> None:
        self._body_edges = unique_edges(body_faces)
        self._between, self._at = _points_between(body_pos, self._body_edges)
        body = self._points(body_pos)
        used = np.unique(faces)
        edges = unique_edges(faces)
        part = connected_components(len(pos), edges)
        numbers, part_of_used = np.unique(part[used], return_inverse=True)
        self._near = cKDTree(body[self._known(body_faces, len(body))])
        dist, nearest = self._near.query(pos)
        nearest = self._known(body_faces, len(body))[nearest]
        loops = [loop for loop in boundary_loops(faces) if rim_length(pos, loop) >= _LEAST_OPENING]
        through = [num_through(pos[loop], body_pos, self._body_edges) for loop in loops]
        self.num_vertices = np.bincount(part_of_used, minlength=len(numbers))
        members = [used[part_of_used == number] for number in range(len(numbers))]
        self.first_vertex = np.array([rows.min() for rows in members], dtype=np.int64)
        self.gap = np.array([dist[rows].min() for rows in members])
        chosen = []
        for number, rows in zip(numbers, members, strict=True):
            own = [(loop, count) for loop, count in zip(loops, through, strict=True) if part[loop[0]] == number]
            chosen.append(_to_follow(rows, dist, own, np.intersect1d(rows, pinned)))
        regions = _Regions(body, self._body_edges, self._between)
        self._touching: list[_Group | None] = []
        self._holds: list[_Hold | None] = []

        def follow(vertices: np.ndarray) -> _Followed:
            return _Followed(vertices, regions.around(nearest[vertices], _FOLLOWED), body)

        for own, (rows, rims) in zip(members, chosen, strict=True):
            share = 0.5 if rims else _HANGS
            self._touching.append(_Group(rows, regions.around(nearest[rows]), dist[rows], share) if len(rows) else None)
            if not rims:
                self._holds.append(None)
                continue
            highest = max(rims, key=lambda rim: float(pos[rim, 1].mean()))
            tops = [follow(_some(top, _OF_TOP)) for top in _tops(pos, edges, own[dist[own] < TOUCHES])]
            touching = follow(_some(rows, _OF_TOUCHING))
            self._holds.append(_Hold(highest, follow(_some(highest, _OF_OPENING)), tops, touching))

    def __call__(self, pos: np.ndarray, body_pos: np.ndarray) -> np.ndarray:
        """``away``, ``slipped``, ``sunk`` and ``shifted`` (4, P) [m] of one frame, see :class:`Wear`."""
        body = self._points(body_pos)
        away, slipped, sunk, shifted = found = np.full((4, len(self._touching)), np.nan)
        for number, (touching, hold) in enumerate(zip(self._touching, self._holds, strict=True)):
            if touching is not None:
                away[number] = touching.away(pos, body)
            if hold is not None:
                lost = num_through(pos[hold.rim], body_pos, self._body_edges) == 0
                slipped[number], sunk[number] = _LOST if lost else hold.slipped(pos, body), hold.sunk(pos, body)
                shifted[number] = hold.shifted(pos, body)
        return found

    def _points(self, body_pos: np.ndarray) -> np.ndarray:
        """Vertices of the body, and points on its edges where it is coarse."""
        if not len(self._between):
            return body_pos
        first, second = body_pos[self._between].swapaxes(0, 1)
        return np.concatenate([body_pos, first + self._at * (second - first)])

    def _known(self, body_faces: np.ndarray, count: int) -> np.ndarray:
        """Points that belong to a face: others are no skin."""
        corners = np.unique(body_faces)
        return np.concatenate([corners, np.arange(count - len(self._between), count)])


def measure_wear(
    pos: np.ndarray,
    faces: np.ndarray,
    body_pos: np.ndarray,
    body_faces: np.ndarray,
    frames: Sequence[int],
    pinned: np.ndarray = _NONE,
) -> Wear | None:
    """:class:`Wear` of a rollout (T, V, 3), (T, W, 3) [m] in ``frames``; None without a body, cloth, or a finite frame 0."""
    if not len(body_faces) or not len(faces) or not (np.isfinite(pos[0]).all() and np.isfinite(body_pos[0]).all()):
        return None
    meter = WearMeter(pos[0].astype(np.float64), faces, body_pos[0].astype(np.float64), body_faces, pinned)
    rows = [meter(pos[frame].astype(np.float64), body_pos[frame].astype(np.float64)) for frame in frames]
    away, slipped, sunk, shifted = np.array(rows).swapaxes(0, 1)
    return Wear(np.asarray(frames), away, slipped, sunk, shifted, meter.num_vertices, meter.first_vertex, meter.gap)


def _squares(pos: np.ndarray, body: np.ndarray, region: np.ndarray) -> np.ndarray:
    """(N, K) m²: from points (N, 3) to those of the body (B, 3) in the ``region`` (N, K) of each, an axis after the other."""
    found, apart = np.zeros(region.shape), np.empty(region.shape)
    for axis in range(3):
        np.take(body[:, axis], region, out=apart, mode="clip")  # which writes there without a check of its own
        apart -= pos[:, axis, None]
        apart *= apart
        found += apart
    return found


def _to_follow(
    rows: np.ndarray, dist: np.ndarray, openings: list[tuple[np.ndarray, int]], held: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Of a part the vertices that touch the body or are held, and its openings around a limb; nothing where it is not worn."""
    touching = np.union1d(rows[dist[rows] < TOUCHES], held)
    if len(touching) < _LEAST_TOUCHING * len(rows) and not any(count >= _THROUGH for _, count in openings):
        return _NONE, []
    if not len(touching):
        touching = rows[np.argsort(dist[rows], kind="stable")[: max(1, len(rows) // 10)]]
    rims = [loop for loop, count in openings if count >= _THROUGH and (dist[loop] < TOUCHES).mean() >= _TIGHT]
    return np.union1d(_some(touching, _MOST_LOOKED_AT), held[:_MOST_LOOKED_AT]), rims


def _tops(pos: np.ndarray, edges: np.ndarray, touching: np.ndarray) -> list[np.ndarray]:
    """The connected pieces of what is highest of the vertices ``touching`` the body."""
    top = touching[pos[touching, 1] > pos[touching, 1].max(initial=-np.inf) - _TOP]
    inside = np.zeros(len(pos), dtype=bool)
    inside[top] = True
    label = connected_components(len(pos), edges[inside[edges].all(axis=1)])[top]
    pieces = [top[label == number] for number in np.unique(label)]
    return [piece for piece in pieces if len(piece) >= _LEAST_TOP]


def _some(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[:: max(1, -(-len(rows) // most))]


class _Regions:
    """Points of the body by distance along the skin."""

    def __init__(self, body: np.ndarray, edges: np.ndarray, between: np.ndarray) -> None:
        count, added = len(body), np.arange(len(body) - len(between), len(body))
        links = np.concatenate([edges, *(np.stack([added, between[:, side]], axis=1) for side in range(2))])
        lengths = np.linalg.norm(body[links[:, 0]] - body[links[:, 1]], axis=1).clip(1e-9)
        self._graph = coo_matrix((lengths, (links[:, 0], links[:, 1])), shape=(count, count)).tocsr()

    def around(self, points: np.ndarray, reach: float = _REGION) -> np.ndarray:
        """(N, K): each of ``points`` (N,) and what is within ``reach`` [m] of it, filled up with itself."""
        own, which = np.unique(points, return_inverse=True)
        found = [
            np.append(point, np.flatnonzero(np.isfinite(row))) for point, row in zip(own, self._far(own, reach), strict=True)
        ]
        most = max((len(row) for row in found), default=1)
        table = np.repeat(own[:, None], most, axis=1)
        for row, near in zip(table, found, strict=True):
            row[: len(near)] = near
        return table[which]

    def _far(self, points: np.ndarray, reach: float, at_once: int = 64) -> list[np.ndarray]:
        """Distances (W,) from each of ``points``, infinite beyond the region."""
        rows: list[np.ndarray] = []
        for first in range(0, len(points), at_once):
            rows += list(dijkstra(self._graph, directed=False, indices=points[first : first + at_once], limit=reach))
        return rows


def _points_between(body_pos: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on long edges: the ends (B, 2) of each one's edge, and how far (B, 1) along it the point is, 0 to 1."""
    length = np.linalg.norm(body_pos[edges[:, 0]] - body_pos[edges[:, 1]], axis=1)
    count = np.clip(np.ceil(length / _COARSE) - 1, 0, _MOST_BETWEEN).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), count)
    place = np.arange(len(edge)) - (np.cumsum(count) - count)[edge] + 1
    return edges[edge], (place / (count[edge] + 1))[:, None]
