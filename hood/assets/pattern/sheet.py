"""A pattern as one mesh: panels triangulated at an edge length, and welded along their stitches."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from hood.assets.pattern.pattern import BODY_HEIGHT, Pattern, PatternPanel
from hood.mesh import topology

#: Points inside a panel keep this share of the edge length from its outline.
_FROM_OUTLINE = 0.6
#: Between panels that lie side by side in the texture [m].
_MARGIN = 0.02
#: Points of a curve that tell how far it reaches; and pairs of points and triangles that are looked at at once.
_CURVED, _AT_ONCE = 32, 1 << 21


@dataclass(frozen=True)
class PatternSheet:
    """Panels that are sewn to each other, where their maker put them; a vertex of a seam is in the middle of its copies.

    Args:
        pos: (V, 3) m.
        faces: (F, 3), wound along the outlines of the panels.
        uv: (U, 2) m, the panels side by side; ``uv_faces`` (F, 3) are the corners of the faces there.
        panels: (F,) bool each.
        outline: (U,) where a point of ``uv`` is on the outline of its panel: the number of the side and the share of its
            length; NaN inside.
        seam: (V,) bool, vertices of a stitch.
        edge_labels: (V,) bool by label of an edge, the vertices along it.
        height: m, of the body around which the panels are placed.
    """

    pos: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray
    panels: Mapping[str, np.ndarray]
    outline: np.ndarray
    seam: np.ndarray
    edge_labels: Mapping[str, np.ndarray]
    height: float = BODY_HEIGHT

    @property
    def flat(self) -> np.ndarray:
        """(F, 3, 2) m: corners of every face in the pattern."""
        return np.asarray(self.uv[self.uv_faces])

    @property
    def welds(self) -> np.ndarray:
        """(U,) vertex of every point of ``uv``."""
        vertex = np.zeros(len(self.uv), dtype=np.int64)
        vertex[self.uv_faces] = self.faces
        return vertex


def sheet_of(pattern: Pattern, edge: float, where: str) -> PatternSheet:
    """The pattern meshed with edges of about ``edge`` [m], sewn.

    The two sides of a stitch have as many vertices, at equal shares of their lengths: gathers are spread evenly.

    Raises:
        ValueError: a panel that cannot be meshed so, or stitches that do not make a sheet of cloth; names ``where``, the panel
            and the repair.
    """
    counts = _divisions(pattern, edge)
    tables, faces, outlines, start = [], [], {}, 0
    placed, owner, places = [], [], []
    labels: dict[str, list[np.ndarray]] = {}
    at = 0.0
    for number, panel in enumerate(pattern.panels.values()):
        points, triangles, sides = _meshed(panel, [counts[panel.name, k] for k in range(len(panel.edges))], edge, where)
        for k, side in enumerate(sides):
            outlines[panel.name, k] = start + side
            if panel.edges[k].label:
                labels.setdefault(panel.edges[k].label, []).append(start + side)
        places.append(np.full(len(points), np.nan))
        for k, side in enumerate(sides):
            places[-1][side[:-1]] = k + np.arange(len(side) - 1) / (len(side) - 1)
        exact = np.concatenate([side.evenly(_CURVED) for side in panel.edges])
        tables.append(points - exact.min(axis=0) + [at, 0.0])  # in one place, whatever the edge length
        at += float(np.ptp(exact[:, 0])) + _MARGIN
        placed.append(panel.placed(points))
        faces.append(triangles + start)
        owner.append(np.full(len(triangles), number))
        start += len(points)
    pos, corners, of_panel = np.concatenate(placed), np.concatenate(faces), np.concatenate(owner)
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for stitch in pattern.stitches:
        first, second = outlines[stitch.first], outlines[stitch.second]
        pairs.append(np.stack([first, second if stitch.same else second[::-1]], axis=1))
    joined = np.concatenate(pairs)
    label = topology.connected_components(start, joined)
    _, welds = np.unique(label, return_inverse=True)
    count = np.bincount(welds)
    middle = np.stack([np.bincount(welds, pos[:, axis]) for axis in range(3)], axis=1) / count[:, None]
    names, welded = list(pattern.panels), welds[corners]
    _check_sheet(welded, of_panel, names, where)
    turned = _turned(welded, of_panel, len(names))
    welded[turned], corners[turned] = welded[turned][:, ::-1], corners[turned][:, ::-1]
    seam = np.zeros(len(count), dtype=bool)
    seam[welds[joined.reshape(-1)]] = True
    marks = {}
    for name, sides in labels.items():
        marks[name] = np.zeros(len(count), dtype=bool)
        marks[name][welds[np.concatenate(sides)]] = True
    own = {name: of_panel == index for index, name in enumerate(names)}
    return PatternSheet(
        middle, welded, np.concatenate(tables), corners, own, np.concatenate(places), seam, marks, pattern.height
    )


def carry_over(coarse: PatternSheet, pos: np.ndarray, fine: PatternSheet) -> np.ndarray:
    """(V, 3) m: the vertices of ``fine`` on ``coarse``, another mesh of the same pattern, whose vertices are at ``pos`` (W, 3).

    On the outline of a panel they keep their side and their share of its length, so that both sides of a stitch agree; inside
    they keep their place in the flat triangles.
    """
    total, count = np.zeros((len(fine.pos), 3)), np.zeros(len(fine.pos))
    at, welds = pos[coarse.welds], fine.welds
    for name, mask in fine.panels.items():
        rows, own = np.unique(fine.uv_faces[mask]), coarse.uv_faces[coarse.panels[name]]
        on_rim = ~np.isnan(fine.outline[rows])
        ring = np.unique(own)
        ring = ring[~np.isnan(coarse.outline[ring])]
        ring = ring[np.argsort(coarse.outline[ring])]
        ring = np.append(ring, ring[0])
        way = coarse.outline[ring]
        way[-1] = np.floor(way[-2]) + 1.0
        rim, inner = rows[on_rim], rows[~on_rim]
        found = np.zeros((len(rows), 3))
        found[on_rim] = _along(way, at[ring], fine.outline[rim])
        if len(inner):
            # Curves are chords in the coarse mesh: points beside them move with them.
            shift = _along(way, coarse.uv[ring], fine.outline[rim]) - fine.uv[rim]
            distance, nearest = cKDTree(fine.uv[rim]).query(fine.uv[inner])
            reach = np.sqrt(np.abs(np.linalg.det(coarse.uv[own][:, 1:] - coarse.uv[own][:, :1])).mean())
            share = np.clip(1.0 - distance / reach, 0.0, 1.0)
            face, bary = _in_triangles(fine.uv[inner] + share[:, None] * shift[nearest], coarse.uv[own])
            found[~on_rim] = np.einsum("nk,nkx->nx", bary, at[own[face]])
        np.add.at(total, welds[rows], found)
        np.add.at(count, welds[rows], 1.0)
    return total / count[:, None]


def _along(way: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """``values`` (K, n) at the places ``way`` (K,), read between them (N, n)."""
    return np.stack([np.interp(wanted, way, column) for column in values.T], axis=1)


def _in_triangles(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangle (N,) of ``corners`` (F, 3, 2) that each of ``points`` (N, 2) lies in, or is beside, and weights (N, 3)."""
    inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
    face, weights = np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 3))
    for rows in np.array_split(np.arange(len(points)), len(points) * len(corners) // _AT_ONCE + 1):
        share = np.einsum("fij,nfj->nfi", inverse, points[rows][:, None] - corners[:, 0])
        bary = np.concatenate([1.0 - share.sum(axis=2, keepdims=True), share], axis=2)
        face[rows] = bary.min(axis=2).argmax(axis=1)
        weights[rows] = bary[np.arange(len(rows)), face[rows]]
    weights = weights.clip(min=0.0)
    return face, weights / weights.sum(axis=1, keepdims=True)


def _divisions(pattern: Pattern, edge: float) -> dict[tuple[str, int], int]:
    """Into how many edges each side of a panel is divided: sewn sides as the longer one asks for."""
    counts = {
        (name, k): max(round(side.length / edge), 1)
        for name, panel in pattern.panels.items()
        for k, side in enumerate(panel.edges)
    }
    for stitch in pattern.stitches:
        most = max(counts[stitch.first], counts[stitch.second])
        # A dart of one edge a side would fold its panel onto itself.
        counts[stitch.first] = counts[stitch.second] = max(most, 2 if stitch.first[0] == stitch.second[0] else 1)
    return counts


def _meshed(panel: PatternPanel, counts: list[int], edge: float, where: str) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Points (N, 2) [m] of a panel, its triangles along the outline's way, and the points of every side, ends included."""
    lines = [side.evenly(count)[:-1] for side, count in zip(panel.edges, counts, strict=True)]
    outline = np.concatenate(lines)
    first = np.cumsum([0, *counts])
    sides = [np.arange(first[k], first[k + 1] + 1) % len(outline) for k in range(len(counts))]
    inner = _grid_inside(outline, edge)
    points = np.concatenate([outline, inner])
    rim = np.stack([np.arange(len(outline)), np.roll(np.arange(len(outline)), -1)], axis=1)
    triangles = np.zeros((0, 3), dtype=np.int64)
    if len(outline) >= 3:
        triangles = Delaunay(points).simplices.astype(np.int64)
        triangles = triangles[_inside(points[triangles].mean(axis=1), outline)]
        corners = points[triangles]
        area = np.linalg.det(corners[:, 1:] - corners[:, :1])
        triangles = triangles[np.abs(area) > 1e-6 * edge * edge]
    sorted_rim = np.sort(rim, axis=1)
    known = {tuple(pair) for pair in np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).tolist()}
    missing = [row for row, pair in enumerate(sorted_rim.tolist()) if tuple(pair) not in known]
    if missing or not len(triangles):
        number = int(np.searchsorted(first, missing[0] if missing else 0, side="right")) - 1
        raise ValueError(
            f"{where}: panel {panel.name!r} is too narrow at edge {panel.numbers[number]} for edges of {1e3 * edge:g} mm; "
            "give a smaller edge=, or widen it"
        )
    area = np.linalg.det(points[triangles][:, 1:] - points[triangles][:, :1])
    along = _signed_area(outline) > 0
    flip = (area > 0) != along
    triangles[flip] = triangles[flip][:, ::-1]
    return points, triangles, sides


def _signed_area(outline: np.ndarray) -> float:
    x, y = outline.T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def _grid_inside(outline: np.ndarray, edge: float) -> np.ndarray:
    """Points (N, 2) of a triangular grid inside an outline, not too near to it."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    rise = edge * np.sqrt(0.75)
    rows = np.arange(low[1] + 0.5 * rise, high[1], rise)
    columns = np.arange(low[0] + 0.25 * edge, high[0], edge)
    x = columns[None] + 0.5 * edge * (np.arange(len(rows))[:, None] % 2)
    points = np.stack([x, np.broadcast_to(rows[:, None], x.shape)], axis=-1).reshape(-1, 2)
    points = points[_inside(points, outline)] if len(points) else points
    if not len(points):
        return np.zeros((0, 2))
    nearest, _ = cKDTree(_dense(outline, edge)).query(points)
    return np.asarray(points[nearest > _FROM_OUTLINE * edge])


def _dense(outline: np.ndarray, edge: float) -> np.ndarray:
    """Points on the outline, a few to an edge."""
    following = np.roll(outline, -1, axis=0)
    count = max(int(np.ceil(4.0 * np.linalg.norm(following - outline, axis=1).max() / edge)), 1)
    share = np.arange(count)[:, None, None] / count
    return np.asarray(((1.0 - share) * outline + share * following).reshape(-1, 2))


def _inside(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 2) inside a closed outline, by the number of its edges to their right."""
    (x, y), following = outline.T, np.roll(outline, -1, axis=0)
    u, v = following.T
    result = np.zeros(len(points), dtype=bool)
    for k in range(len(outline)):
        crossed = (y[k] > points[:, 1]) != (v[k] > points[:, 1])
        if crossed.any():
            height = (points[crossed, 1] - y[k]) / (v[k] - y[k])
            result[crossed] ^= points[crossed, 0] < x[k] + height * (u[k] - x[k])
    return result


def _check_sheet(faces: np.ndarray, of_panel: np.ndarray, names: list[str], where: str) -> None:
    """Raise ValueError unless the welded faces are a sheet: three corners each, and two faces at most to an edge."""
    folded = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if folded.any():
        name = names[of_panel[int(folded.argmax())]]
        raise ValueError(f"{where}: panel {name!r} is sewn to itself over one edge; give a smaller edge=, or mend its stitches")
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, row, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    bad = np.flatnonzero(count > 2)
    if len(bad):
        meet = np.unique(of_panel[np.flatnonzero(row.reshape(-1) == bad[0]) // 3])
        found = ", ".join(repr(names[index]) for index in meet)
        raise ValueError(f"{where}: more than two layers of cloth meet in one seam, of panels {found}; remove a stitch there")


def _turned(faces: np.ndarray, of_panel: np.ndarray, count: int) -> np.ndarray:
    """(F,) bool: faces of panels that are turned over, so that neighbours are wound alike wherever that can be had."""
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(of_panel, 3)
    order = np.lexsort(np.sort(half, axis=1).T)
    key = np.sort(half, axis=1)[order]
    same = np.flatnonzero((key[1:] == key[:-1]).all(axis=1))
    first, second = order[same], order[same + 1]
    across = owner[first] != owner[second]
    clash = (half[first] == half[second]).all(axis=1)
    votes = np.zeros((count, count))
    np.add.at(votes, (owner[first][across], owner[second][across]), np.where(clash[across], -1.0, 1.0))
    votes += votes.T
    turn = np.zeros(count, dtype=np.int64)
    for seed in range(count):
        if turn[seed]:
            continue
        turn[seed], queue = 1, deque([seed])
        while queue:
            here = queue.popleft()
            for other in np.flatnonzero(votes[here]):
                if not turn[other]:
                    turn[other] = turn[here] * (1 if votes[here, other] > 0 else -1)
                    queue.append(int(other))
    return np.asarray((turn < 0)[of_panel])
