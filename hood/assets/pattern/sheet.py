"""A pattern as one mesh: panels triangulated at an edge length, and welded along their stitches."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from hood.assets.pattern.making import Fastener, construction_of, laid
from hood.assets.pattern.pattern import BODY_HEIGHT, LINING, Pattern, PatternPanel
from hood.mesh import topology
from hood.mesh.flat import Construction, in_triangles, inside

#: Points inside a panel keep this share of the edge length from its outline.
_FROM_OUTLINE = 0.6
#: An end of a fold within this [m] of the outline is on it, and within this share of the edge length of a corner in that;
#: points of a side that tell where it is.
_ON_OUTLINE, _AT_CORNER, _FINE = 2e-3, 0.25, 257
#: Pieces of folds are halved so often at most.
_HALVED = 5
#: Between panels that lie side by side in the texture [m].
_MARGIN = 0.02
#: Points of a curve that tell how far it reaches.
_CURVED = 32
#: No pairs.
_NONE = np.zeros((0, 2), dtype=np.int64)


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
        made: its elastic, its folds and how stiff its seams and hems are.
        stiffness: (V,) how many times as stiff as the fabric the cloth is; None: once.
        joins: (J, 2) points of ``uv`` that seams join.
        seams: points (N,) of ``uv`` along every stitch, by its number and edges in words.
        fastened: seams that are to be opened: what closes them, and their points (N, 2) of ``uv``.
        rows: of an opened sheet, (P, 2) vertices by name that close it; ``rims`` (N, 2) are all that face each other there, and
            ``closed`` (G, 3) faces as if each of these were one.
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
    made: Construction = Construction()
    stiffness: np.ndarray | None = None
    joins: np.ndarray = field(default_factory=lambda: _NONE)
    seams: Mapping[str, np.ndarray] = field(default_factory=dict)
    fastened: tuple[tuple[Fastener, np.ndarray], ...] = ()
    rows: Mapping[str, np.ndarray] = field(default_factory=dict)
    rims: np.ndarray = field(default_factory=lambda: _NONE)
    closed: np.ndarray | None = None

    @property
    def flat(self) -> np.ndarray:
        """(F, 3, 2) m: corners of every face in the pattern."""
        return np.asarray(self.uv[self.uv_faces])

    @property
    def gathered(self) -> np.ndarray:
        """(V,) bool: vertices of faces with elastic."""
        found = np.zeros(len(self.pos), dtype=bool)
        if self.made.elastic is not None:
            found[self.faces[(self.made.elastic != 1.0).any(axis=1)]] = True
        return found

    @property
    def welds(self) -> np.ndarray:
        """(U,) vertex of every point of ``uv``."""
        vertex = np.zeros(len(self.uv), dtype=np.int64)
        vertex[self.uv_faces] = self.faces
        return vertex


def sheet_of(pattern: Pattern, edge: float, where: str) -> PatternSheet:
    """The pattern meshed with edges of about ``edge`` [m], sewn.

    The two sides of a stitch have as many vertices, at equal shares of their lengths: gathers are spread evenly. Edges lie
    along folds.

    Raises:
        ValueError: a panel that cannot be meshed so, or stitches that do not make a sheet of cloth; names ``where``, the panel
            and the repair.
    """
    ends = {panel.name: _fold_ends(panel, edge) for panel in pattern.panels.values()}
    shares = _divisions(pattern, edge, ends)
    tables, faces, outlines, creases, start = [], [], {}, {}, 0
    placed, owner, places = [], [], []
    labels: dict[str, list[np.ndarray]] = {}
    at = 0.0
    for number, panel in enumerate(pattern.panels.values()):
        own = [shares[panel.name, k] for k in range(len(panel.edges))]
        points, triangles, sides, lines = _meshed(panel, own, ends[panel.name], edge, where)
        creases[panel.name] = [start + line for line in lines]
        for k, side in enumerate(sides):
            outlines[panel.name, k] = start + side
            if panel.edges[k].label:
                labels.setdefault(panel.edges[k].label, []).append(start + side)
        places.append(np.full(len(points), np.nan))
        for k, side in enumerate(sides):
            places[-1][side[:-1]] = k + own[k][:-1]
        exact = np.concatenate([side.evenly(_CURVED) for side in panel.edges])
        tables.append(points - exact.min(axis=0) + [at, 0.0])  # in one place, whatever the edge length
        at += float(np.ptp(exact[:, 0])) + _MARGIN
        placed.append(_begun(panel, points, ends[panel.name]))
        faces.append(triangles + start)
        owner.append(np.full(len(triangles), number))
        start += len(points)
    pos, corners, of_panel = np.concatenate(placed), np.concatenate(faces), np.concatenate(owner)
    joins, fastened = _joined(pattern, outlines)
    joined = np.concatenate([joins, *(pair for _, pair in fastened)])
    label = topology.connected_components(start, joined)
    _, welds = np.unique(label, return_inverse=True)
    count = np.bincount(welds)
    middle = np.stack([np.bincount(welds, pos[:, axis]) for axis in range(3)], axis=1) / count[:, None]
    names, welded = list(pattern.panels), welds[corners]
    made = construction_of(pattern, corners, np.concatenate(tables), of_panel, outlines, creases)
    _check_sheet(welded, of_panel, pattern, where)
    turned = _turned(welded, of_panel, len(names))
    welded[turned], corners[turned] = welded[turned][:, ::-1], corners[turned][:, ::-1]
    made = made.turned(turned)
    seam = np.zeros(len(count), dtype=bool)
    seam[welds[joined.reshape(-1)]] = True
    marks = {}
    for name, sides in labels.items():
        marks[name] = np.zeros(len(count), dtype=bool)
        marks[name][welds[np.concatenate(sides)]] = True
    parts = {name: of_panel == index for index, name in enumerate(names)}
    sewn = PatternSheet(
        middle, welded, np.concatenate(tables), corners, parts, np.concatenate(places), seam, marks, pattern.height, made
    )
    seams = {pattern.told(number): outlines[stitch.first] for number, stitch in enumerate(pattern.stitches)}
    return replace(sewn, joins=joins, seams=seams, fastened=fastened)


def _joined(
    pattern: Pattern, outlines: Mapping[tuple[str, int], np.ndarray]
) -> tuple[np.ndarray, tuple[tuple[Fastener, np.ndarray], ...]]:
    """``joins`` and ``fastened`` of a sheet."""
    pairs, fastened = [_NONE], []
    for stitch in pattern.stitches:
        first, second = outlines[stitch.first], outlines[stitch.second]
        pair = np.stack([first, second if stitch.same else second[::-1]], axis=1)
        if stitch.fastener is None:
            pairs.append(pair)
        else:
            fastened.append((stitch.fastener, pair))
    return np.concatenate(pairs), tuple(fastened)


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
            face, bary = in_triangles(fine.uv[inner] + share[:, None] * shift[nearest], coarse.uv[own])
            found[~on_rim] = np.einsum("nk,nkx->nx", bary, at[own[face]])
        np.add.at(total, welds[rows], found)
        np.add.at(count, welds[rows], 1.0)
    return total / count[:, None]


def _along(way: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """``values`` (K, n) at the places ``way`` (K,), read between them (N, n)."""
    return np.stack([np.interp(wanted, way, column) for column in values.T], axis=1)


#: Where ends of folds lie on the outline of a panel: (side, share of its length); None: inside.
_Place = tuple[int, float] | None


def _begun(panel: PatternPanel, points: np.ndarray, ends: list[tuple[_Place, _Place]]) -> np.ndarray:
    """(N, 3) m: where points (N, 2) of a panel begin, its pleats laid; these are folds from outline to outline."""
    across = all(place is not None for pair in ends for place in pair)
    outer = float(np.sign(_signed_area(np.array([edge.start for edge in panel.edges]))))
    return np.asarray(laid(points, panel.folds if across else (), outer) @ panel.rotation.T + panel.translation)


def _fold_ends(panel: PatternPanel, edge: float) -> list[tuple[_Place, _Place]]:
    """Where the folds of a panel begin and end; what is near to a corner of the outline ends in it."""
    places: list[_Place] = []
    shares = np.linspace(0.0, 1.0, _FINE)
    for point in [end for fold in panel.folds for end in (fold.start, fold.end)]:
        place: _Place = None
        nearest = _ON_OUTLINE
        for k, side in enumerate(panel.edges):
            line = side.along(shares)
            way = np.diff(line, axis=0)
            along = np.clip(((point - line[:-1]) * way).sum(axis=1) / (way * way).sum(axis=1), 0.0, 1.0)
            distance = np.linalg.norm(line[:-1] + along[:, None] * way - point, axis=1)
            at = int(distance.argmin())
            if distance[at] < nearest:
                share, near = (at + float(along[at])) / (_FINE - 1), _AT_CORNER * edge / side.length
                place = k, 0.0 if share < near else 1.0 if share > 1.0 - near else share
                nearest = float(distance[at])
        places.append(place)
    return list(zip(places[::2], places[1::2], strict=True))


def _divisions(
    pattern: Pattern, edge: float, ends: Mapping[str, list[tuple[_Place, _Place]]]
) -> dict[tuple[str, int], np.ndarray]:
    """Shares of the length of each side of a panel at which it has vertices, 0 and 1 among them: sewn sides are divided alike,
    as the longer one asks for, and where folds end there is one."""
    sides = {(name, k): side for name, panel in pattern.panels.items() for k, side in enumerate(panel.edges)}
    at: dict[tuple[str, int], set[float]] = {key: {0.0, 1.0} for key in sides}
    for name, places in ends.items():
        for place in (place for pair in places for place in pair if place is not None):
            at[name, place[0]].add(place[1])
    lengths, least = {key: side.length for key, side in sides.items()}, dict.fromkeys(sides, 1)
    for stitch in pattern.stitches:
        first, second = stitch.first, stitch.second
        both = at[first] | (at[second] if stitch.same else {1.0 - share for share in at[second]})
        at[first], at[second] = both, both if stitch.same else {1.0 - share for share in both}
        lengths[first] = lengths[second] = max(lengths[first], lengths[second])
        # A dart of one edge a side would fold its panel onto itself.
        least[first] = least[second] = 2 if first[0] == second[0] else 1
    found = {}
    for key, shares in at.items():
        steps = _apart(shares, _AT_CORNER * edge / lengths[key])
        parts = np.maximum(
            np.round(np.diff(steps) * lengths[key] / edge).astype(np.int64), least[key] if len(steps) == 2 else 1
        )
        inner = [np.linspace(low, high, n + 1)[:-1] for low, high, n in zip(steps[:-1], steps[1:], parts, strict=True)]
        found[key] = np.append(np.concatenate(inner), 1.0)
    return found


def _apart(shares: set[float], least: float) -> np.ndarray:
    """Shares of a side in their order, as one where they are nearer than ``least``: ends of folds on both sides of a stitch."""
    steps = np.unique(np.round(sorted(shares), 9))
    group = np.cumsum(np.diff(steps, prepend=-np.inf) > min(least, 0.5))  # a side that is shorter than that has its two ends
    middle = np.bincount(group, steps)[1:] / np.bincount(group)[1:]
    middle[0], middle[-1] = 0.0, 1.0
    return np.asarray(middle)


def _meshed(
    panel: PatternPanel, shares: list[np.ndarray], ends: list[tuple[_Place, _Place]], edge: float, where: str
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Points (N, 2) [m] of a panel, its triangles along the outline's way, and the points of every side and fold, ends
    included."""
    lines = [side.along(share)[:-1] for side, share in zip(panel.edges, shares, strict=True)]
    outline = np.concatenate(lines)
    first = np.cumsum([0, *(len(line) for line in lines)])
    sides = [np.arange(first[k], first[k + 1] + 1) % len(outline) for k in range(len(lines))]
    points, creases = _creased(panel, outline, sides, shares, ends, edge, where)
    inner = _gridinside(outline, edge)
    if len(creases) and len(inner):
        dense = np.concatenate([_dense(points[line], edge) for line in creases])
        inner = inner[cKDTree(dense).query(inner)[0] > _FROM_OUTLINE * edge]
    points = np.concatenate([points, inner])
    rim = np.stack([np.arange(len(outline)), np.roll(np.arange(len(outline)), -1)], axis=1)
    triangles = np.zeros((0, 3), dtype=np.int64)
    if len(outline) >= 3:
        triangles = Delaunay(points).simplices.astype(np.int64)
        triangles = triangles[inside(points[triangles].mean(axis=1), outline)]
        corners = points[triangles]
        area = np.linalg.det(corners[:, 1:] - corners[:, :1])
        triangles = triangles[np.abs(area) > 1e-6 * edge * edge]
    missing = _missing(triangles, rim)
    if len(missing) or not len(triangles):
        number = int(np.searchsorted(first, missing[0] if len(missing) else 0, side="right")) - 1
        raise ValueError(
            f"{where}: panel {panel.name!r} is too narrow at edge {panel.numbers[number]} for edges of {1e3 * edge:g} mm; "
            "give a smaller edge=, or widen it"
        )
    for number, line in enumerate(creases):
        if len(_missing(triangles, np.stack([line[:-1], line[1:]], axis=1))):
            raise ValueError(
                f"{where}: panel {panel.name!r}: fold {number} leaves the panel, or is too near to its outline or to another "
                f"fold for edges of {1e3 * edge:g} mm; give a smaller edge=, or move it"
            )
    area = np.linalg.det(points[triangles][:, 1:] - points[triangles][:, :1])
    along = _signed_area(outline) > 0
    flip = (area > 0) != along
    triangles[flip] = triangles[flip][:, ::-1]
    return points, triangles, sides, creases


def _missing(triangles: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Rows of pairs (N, 2) of points that are no side of a triangle."""
    known = {tuple(pair) for pair in np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).tolist()}
    return np.flatnonzero([tuple(pair) not in known for pair in np.sort(pairs, axis=1).tolist()])


def _creased(
    panel: PatternPanel,
    outline: np.ndarray,
    sides: list[np.ndarray],
    shares: list[np.ndarray],
    ends: list[tuple[_Place, _Place]],
    edge: float,
    where: str,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The outline (N, 2) with points along the folds behind it, and which of them every fold has."""
    points, creases = [outline], []
    count = len(outline)
    for fold, places in zip(panel.folds, ends, strict=True):
        tips = []
        for place, end in zip(places, (fold.start, fold.end), strict=True):
            if place is None:
                if not inside(end[None], outline)[0]:
                    x, y = 1e2 * end
                    raise ValueError(
                        f"{where}: panel {panel.name!r}: the end ({x:.1f}, {y:.1f}) cm of a fold is outside; move it"
                    )
                points.append(end[None])
                tips.append(count)
                count += 1
            else:
                tips.append(int(sides[place[0]][np.abs(shares[place[0]] - place[1]).argmin()]))
        start, last = (np.concatenate(points)[tip] for tip in tips)
        parts = max(round(float(np.linalg.norm(last - start)) / edge), 1)
        share = np.linspace(0.0, 1.0, parts + 1)[1:-1, None]
        points.append((1.0 - share) * start + share * last)
        creases.append(np.array([tips[0], *range(count, count + parts - 1), tips[1]]))
        count += parts - 1
    return _divided(np.concatenate(points), creases)


def _divided(points: np.ndarray, creases: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """The same with pieces of folds divided in half while another point lies in the circle around one: those that no circle
    has another point in are sides of triangles."""
    for _ in range(_HALVED if creases else 0):
        tree, before = cKDTree(points), len(points)
        for number, line in enumerate(creases):
            start, end = points[line[:-1]], points[line[1:]]
            middle, radius = 0.5 * (start + end), 0.5 * np.linalg.norm(end - start, axis=1)
            near = np.flatnonzero(tree.query(middle)[0] < (1.0 - 1e-6) * radius)
            creases[number] = np.insert(line, near + 1, len(points) + np.arange(len(near)))
            points = np.concatenate([points, middle[near]])
        if len(points) == before:
            break
    return points, creases


def _signed_area(outline: np.ndarray) -> float:
    x, y = outline.T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def _gridinside(outline: np.ndarray, edge: float) -> np.ndarray:
    """Points (N, 2) of a triangular grid inside an outline, not too near to it."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    rise = edge * np.sqrt(0.75)
    rows = np.arange(low[1] + 0.5 * rise, high[1], rise)
    columns = np.arange(low[0] + 0.25 * edge, high[0], edge)
    x = columns[None] + 0.5 * edge * (np.arange(len(rows))[:, None] % 2)
    points = np.stack([x, np.broadcast_to(rows[:, None], x.shape)], axis=-1).reshape(-1, 2)
    points = points[inside(points, outline)] if len(points) else points
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


def _check_sheet(faces: np.ndarray, of_panel: np.ndarray, pattern: Pattern, where: str) -> None:
    """Raise ValueError unless the welded faces are a sheet: three corners each, and two faces at most to an edge."""
    names = list(pattern.panels)
    folded = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if folded.any():
        name = names[of_panel[int(folded.argmax())]]
        raise ValueError(f"{where}: panel {name!r} is sewn to itself over one edge; give a smaller edge=, or mend its stitches")
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, row, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    bad = np.flatnonzero(count > 2)
    if len(bad):
        meet = {names[index] for index in of_panel[np.flatnonzero(row.reshape(-1) == bad[0]) // 3]}
        between = [str(k) for k, stitch in enumerate(pattern.stitches) if {stitch.first[0], stitch.second[0]} <= meet]
        raise ValueError(
            f"{where}: more than two layers of cloth meet in one seam, of panels {', '.join(map(repr, sorted(meet)))}; "
            f"remove one of stitches {', '.join(between)}; {LINING}"
        )


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
