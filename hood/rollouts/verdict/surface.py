"""What the skin does to the cloth's surface in a frame: triangles that it cuts, how far it sticks out, cloth through cloth.

Contact acts at the cloth's vertices, and ``penetration_*`` counts those. The flat triangles between them can cut the skin's
curve while every vertex is outside; that is what is measured here, from the two surfaces alone: nothing is shared with the
contact energy or its search.

Whether a viewer can see a place: from one of many sides nothing of cloth and body lies before it.

Skin through cloth and cloth through cloth in the frames of a rollout: what is seen, what the start had, what nobody sees.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hood.assets.garment.garment import Garment
from hood.mesh.penetration.compiled import Eights, eights
from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.mesh.penetration.exposure import Sheet, skin_depth
from hood.mesh.topology import unique_edges
from hood.rollouts.file.reader import RolloutData

SURFACE_METRICS = ("cut_face_share", "cut_edge_share", "skin_depth", "self_crossings", "garment_crossings", "cut_in_folds")
#: Frames from one measurement to the next: less than 1 ms a frame at 1,000 vertices, 1 ms at 12,000.
SURFACE_STRIDE = 5
#: Cloth with a median edge of more than so many times that at rest is no garment any more.
TATTERS = 3.0


class SurfaceMeter:
    """Measures frames of one garment, or outfit, on one body.

    Args:
        garment: its faces and, of an outfit, which piece a vertex belongs to.
        body_faces: (G, 3); empty without a body.
    """

    def __init__(self, garment: Garment, body_faces: np.ndarray) -> None:
        self._faces, self._body_faces = np.asarray(garment.faces), np.asarray(body_faces).reshape(-1, 3)
        self._sheet = Sheet.of(self._faces)
        self._edges = self._sheet.edges
        lengths = _lengths(np.asarray(garment.rest_pos), self._edges)
        self._longest = TATTERS * float(np.median(lengths)) if len(lengths) else np.inf
        self._cloth = eights(self._faces, garment.rest_pos)
        self._body: Eights | None = None
        piece = np.zeros(len(garment.rest_pos), dtype=np.int64) if garment.piece is None else garment.piece
        self._piece = piece[self._faces[:, 0]]

    def __call__(self, pos: np.ndarray, body_pos: np.ndarray) -> dict[str, float]:
        """:data:`SURFACE_METRICS` of cloth (V, 3) and body (W, 3), both [m] in one frame.

        ``cut_face_share`` and ``cut_edge_share`` are the shares of the cloth's faces and edges that the body's surface cuts,
        ``skin_depth`` [m] is how far the body sticks out through them (:func:`hood.mesh.penetration.exposure.skin_depth`).
        ``self_crossings`` is the number of pairs of faces of one garment that pass through each other and share no vertex,
        ``garment_crossings`` that of faces of two garments of an outfit. What crossing means:
        :mod:`hood.mesh.penetration.crossing`. ``cut_in_folds`` is the part of ``cut_face_share`` whose faces are caught where
        the body passes through itself, as in the bend of an elbow, see :func:`in_folds`.

        NaN where a position is not finite, and where the cloth is in tatters, its median edge more than :data:`TATTERS` times
        as long as at rest: nearly all of its triangles would have to be compared with each other, to say no more than that.
        """
        pos, body_pos = np.asarray(pos, dtype=np.float64), np.asarray(body_pos, dtype=np.float64)
        if not (np.isfinite(pos).all() and np.isfinite(body_pos).all()):
            return dict.fromkeys(SURFACE_METRICS, float("nan"))
        if self._in_tatters(pos):
            return dict.fromkeys(SURFACE_METRICS, float("nan"))
        cloth, self._body = self._cloth, self._body or eights(self._body_faces, body_pos)
        both = None if cloth is None or self._body is None else (cloth, self._body)
        cut = crossings(pos, self._faces, body_pos, self._body_faces, both)
        pairs = self_crossings(pos, self._faces, cloth)
        same = self._piece[pairs[:, 0]] == self._piece[pairs[:, 1]]
        values = (
            _num_groups(cut.pairs[:, :1]) / max(len(self._faces), 1),
            _num_groups(cut.first_edges[:, :2]) / max(len(self._edges), 1),
            skin_depth(pos, self._faces, body_pos, self._body_faces, cut, self._sheet, both),
            float(same.sum()),
            float((~same).sum()),
            _num_groups(cut.pairs[in_folds(cut.pairs[:, 1], body_pos, self._body_faces, self._body), :1])
            / max(len(self._faces), 1),
        )
        return dict(zip(SURFACE_METRICS, values, strict=True))

    def _in_tatters(self, pos: np.ndarray) -> bool:
        lengths = _lengths(pos, self._edges)
        longer = 2 * int(np.count_nonzero(lengths > self._longest))
        # The median lies between two lengths where these are half of them.
        return longer > len(lengths) or (longer == len(lengths) > 0 and bool(np.median(lengths) > self._longest))


def in_folds(cutting: np.ndarray, body_pos: np.ndarray, body_faces: np.ndarray, body: Eights | None = None) -> np.ndarray:
    """Which of the faces ``cutting`` (N,) of a body are in a fold, (N,) bool: they pass through another face of it, or share a
    vertex with one that does. Cloth between two parts of a body that are in one place cannot be outside both.

    ``body``: :func:`hood.mesh.penetration.compiled.eights` of the faces, where they are known.
    """
    if not len(cutting):
        return np.zeros(0, dtype=bool)
    through = np.zeros(len(body_pos), dtype=bool)
    through[body_faces[np.unique(self_crossings(body_pos, body_faces, body))]] = True
    return np.asarray(through[body_faces[cutting]].any(axis=1))


def _num_groups(rows: np.ndarray) -> int:
    """Different ones among sorted rows."""
    return int((rows[1:] != rows[:-1]).any(axis=1).sum()) + 1 if len(rows) else 0


def _lengths(pos: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1)


#: Sides that are looked from: degrees around the vertical, and above the horizon. Nobody looks from under the floor.
_AROUND, _ABOVE = np.arange(0.0, 360.0, 30.0), (-15.0, 15.0, 45.0)
#: Width [m] of what is looked through, and how far [m] a place may lie behind the foremost surface there.
_CELL, _BEHIND = 0.008, 0.012
#: Surfaces are sampled a little finer than that.
_SPACING = 0.006
_MOST_PARTS = 24


def visible(places: np.ndarray, surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Which of ``places`` (N, 3) [m] can be seen, (N,) bool.

    Args:
        surfaces: positions (V, 3) [m] and faces (F, 3) of all that can hide them.
    """
    hidden = np.arange(len(places))  # so far: what one side sees is not asked for again
    if not len(hidden):
        return np.zeros(0, dtype=bool)
    points = np.concatenate([sampled(pos, faces) for pos, faces in surfaces]).T.copy()
    for towards in _directions():
        right, up = _across(towards)
        hidden = hidden[~_foremost(places[hidden].T, points, (right, up, towards))]
        if not len(hidden):
            break
    seen = np.ones(len(places), dtype=bool)
    seen[hidden] = False
    return seen


def _foremost(places: np.ndarray, points: np.ndarray, axes: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Which places (3, N) are not behind a point (3, M), seen along the third of the ``axes``."""
    right, up, towards = axes
    across, height = _along(right, places), _along(up, places)
    x = _along(right, points)
    points = points[:, (x >= across.min() - _CELL) & (x <= across.max() + _CELL)]
    y = _along(up, points)
    points = points[:, (y >= height.min() - _CELL) & (y <= height.max() + _CELL)]
    own, where = np.unique(_cells(across, height), return_inverse=True)
    cells = _cells(_along(right, points), _along(up, points))
    slot = np.searchsorted(own, cells).clip(max=len(own) - 1)
    within = own[slot] == cells
    front = np.full(len(own), -np.inf)
    np.maximum.at(front, slot[within], _along(towards, points)[within])
    return np.asarray(_along(towards, places) >= front[where] - _BEHIND)


def _cells(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(N,) numbers of the cells; those of torn cloth beyond 10,000 km are one."""
    column, row = (np.floor(np.clip(values / _CELL, -(2.0**30), 2.0**30)).astype(np.int64) for values in (x, y))
    return column * 2**31 + row


def _along(axis: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Coordinates (N,) of points (3, N); written out, as a product of matrices so narrow is slow in some libraries."""
    return np.asarray(axis[0] * points[0] + axis[1] * points[1] + axis[2] * points[2])


def sampled(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Points (M, 3) of a surface, no farther than some millimetres from each other."""
    corners = pos[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.clip(np.ceil(longest / _SPACING), 1, _MOST_PARTS).astype(np.int64)
    clouds = [pos]
    for count in np.unique(parts):
        weights = _grid(int(count))
        clouds.append(np.einsum("wk,fkx->fwx", weights, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(clouds)


def _grid(parts: int) -> np.ndarray:
    """Barycentric weights (W, 3) of the middles of a triangle's ``parts``² pieces."""
    rows = []
    for i in range(parts):
        for j in range(parts - i):
            rows.append((i + 1 / 3, j + 1 / 3))
            if i + j < parts - 1:
                rows.append((i + 2 / 3, j + 2 / 3))
    first, second = np.array(rows).T / parts
    return np.stack([first, second, 1.0 - first - second], axis=1)


def _directions() -> np.ndarray:
    """Unit vectors (D, 3) towards the viewer, y up."""
    around, above = (values.ravel() for values in np.meshgrid(np.radians(_AROUND), np.radians(_ABOVE)))
    return np.stack([np.cos(above) * np.sin(around), np.sin(above), np.cos(above) * np.cos(around)], axis=1)


def _across(towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    return right, np.cross(towards, right)


#: Frames that are measured where the rollout has not, and in which places are looked at from all sides, at most.
_MEASURED, _LOOKED_AT = 12, 4
#: A share of the cloth's triangles that is hardly anything.
HARDLY = 0.001
#: Moments nearer [s] than this are the same.
_SAME = 1e-6


@dataclass(frozen=True)
class Meshes:
    """The simulated mesh of a rollout in its stored frames, and the body."""

    cloth: np.ndarray  # (T, V, 3) m
    faces: np.ndarray  # (F, 3)
    rest_pos: np.ndarray  # (V, 3) m
    body: np.ndarray  # (T, W, 3) m
    body_faces: np.ndarray  # (G, 3)
    piece: np.ndarray | None  # (V,) garment of an outfit
    step: np.ndarray  # (T,) the simulated frame of each, or the nearest
    pinned: np.ndarray  # (P,) vertices that are held, as far as the file says
    flat_length: np.ndarray | None = None  # (E,) m, edges at rest where that is a flat pattern; None: as in rest_pos

    @cached_property
    def rest_length(self) -> np.ndarray:
        """(E,) m at rest, of the unique edges of ``faces``."""
        if self.flat_length is not None:
            return self.flat_length
        start, end = unique_edges(self.faces.astype(np.int64)).T
        return np.asarray(np.linalg.norm(self.rest_pos[end] - self.rest_pos[start], axis=1))

    @property
    def edge_length(self) -> float:
        """The median of its edges at rest [m]."""
        return float(np.median(self.rest_length)) if len(self.rest_length) else 0.0


def meshes_of(data: RolloutData) -> Meshes:
    """Of a rollout that was read back."""
    faces = data.cloth_faces[: len(data.cloth_faces) - data.riding[1]]
    count = data.cloth_pos.shape[1] - data.riding[0]
    if data.refined is not None:
        faces, count = data.refined.faces, data.refined.num_coarse
    piece = data.still.get("piece")
    times = data.step_time
    step = np.abs(times[None] - data.time[:, None]).argmin(axis=1) if data.steps is not None else np.arange(len(data.time))
    return Meshes(
        data.cloth_pos[:, :count],
        np.asarray(faces, dtype=np.int64),
        np.asarray(data.rest_pos[:count], dtype=np.float64),
        data.body_pos,
        np.asarray(data.body_faces, dtype=np.int64),
        None if piece is None else piece[:count],
        step,
        data.still.get("pinned", np.zeros(0, dtype=np.int64)).astype(np.int64),
        data.still.get("rest_length"),
    )


def surface_metrics(data: RolloutData, meshes: Meshes) -> dict[str, np.ndarray]:
    """:data:`hood.rollouts.verdict.surface.SURFACE_METRICS` (S,) of the simulated frames, NaN where not measured; of a rollout
    that measured none a dozen of its stored frames are, of those that were simulated. All stored frames between measured ones
    are measured as well where the skin cuts the cloth in one of these: what comes through for a moment lies between them."""
    count = len(data.step_finite)
    table = {name: np.array(data.step_metrics.get(name, np.full(count, np.nan))) for name in SURFACE_METRICS}
    simulated = np.flatnonzero(np.abs(data.step_time[meshes.step] - data.time) < _SAME)
    if not len(simulated) or not len(meshes.faces):
        return table
    garment = Garment("", meshes.rest_pos, meshes.faces, np.zeros(len(meshes.rest_pos), dtype=bool), piece=meshes.piece)
    meter = SurfaceMeter(garment, meshes.body_faces)

    def measure(frames: np.ndarray) -> None:
        for frame in frames.tolist():
            for name, value in meter(meshes.cloth[frame], meshes.body[frame]).items():
                table[name][meshes.step[frame]] = value

    if not np.isfinite(table["cut_face_share"]).any():
        measure(simulated[np.unique(np.linspace(0, len(simulated) - 1, _MEASURED).astype(np.int64))])
    share = table["cut_face_share"]
    cut = np.nan_to_num(share) - np.nan_to_num(table["cut_in_folds"]) > HARDLY
    measure(simulated[_beside(np.isfinite(share), cut)[meshes.step[simulated]]])
    return table


def _beside(measured: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(S,) bool: frames that were not ``measured`` (S,) between two that were, of which one is ``chosen`` (S,)."""
    known = np.flatnonzero(measured)
    beside = np.zeros(len(measured), dtype=bool)
    for first, last in itertools.pairwise(known.tolist()):
        beside[first + 1 : last] = chosen[first] or chosen[last]
    return beside


def visible_crossings(meshes: Meshes, counts: np.ndarray, most: float) -> dict[int, tuple[int, int]]:
    """Pairs of triangles of cloth through each other, of one garment or of two, that a viewer can see.

    Args:
        counts: (S,) pairs of the simulated frames, NaN where not measured.
        most: frames with more are of interest; the worst of them and some others are looked at.

    Returns:
        By simulated frame: how many of the pairs are seen, and how many there are.
    """
    stored = {int(step): frame for frame, step in enumerate(meshes.step)}
    over = [step for step in np.flatnonzero(np.nan_to_num(counts) > most).tolist() if step in stored]
    if not over:
        return {}
    worst = max(over, key=lambda step: counts[step])
    places = np.unique(np.linspace(0, len(over) - 1, min(len(over), _LOOKED_AT)).astype(np.int64))
    chosen = sorted({worst, *(over[place] for place in places)})
    return {step: _seen_at(meshes, stored[step]) for step in chosen}


def _seen_at(meshes: Meshes, frame: int) -> tuple[int, int]:
    pos, body = meshes.cloth[frame].astype(np.float64), meshes.body[frame].astype(np.float64)
    pairs = self_crossings(pos, meshes.faces)
    places = pos[meshes.faces[pairs]].mean(axis=(1, 2))
    return int(visible(places, [(pos, meshes.faces), (body, meshes.body_faces)]).sum()), len(pairs)


def spread_over(values: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """``values`` (S,) with those that are NaN taken from the nearest known one, in ``measured`` frames; 0 elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return np.zeros(len(values))
    nearest = known[np.abs(np.arange(len(values))[:, None] - known[None]).argmin(axis=1)]
    return np.where(measured, values[nearest], 0.0)
