"""Fronts that open: panels across the middle are divided there, and closed by buttons or a zip."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from hood.assets.pattern.blocks import XY, Place, Side, SideKey, Table, both_halves, draw_strip, trunk_place
from hood.assets.pattern.making import EdgeMaking, Fastener, Fold
from hood.assets.pattern.measures import Measures
from hood.assets.pattern.pattern import Edge, Stitch
from hood.assets.pattern.sheet import PatternSheet
from hood.mesh import geometry, topology
from hood.mesh.flat import SIDE_TABLES, Construction, in_triangles

#: What an opening may be closed by: rows of fasteners, and what lies below them.
CLOSURES = {"buttons": Fastener("front_buttons", 0.08, 0.03), "zip": Fastener("front_zip", 0.0, 0.02)}
#: The edges of an opening are so stiff: a placket of three layers, and the tape of a zip.
_PLACKETS = {"buttons": EdgeMaking(bending=8.0, width=0.03), "zip": EdgeMaking(bending=4.0, width=0.012)}
#: Points within this [m] of the middle are on it.
_MIDDLE = 1e-6
#: Between pieces that lie side by side in the texture [m].
_APART = 0.02
#: An edge that lies over another is so far [m] from it, and comes down to its own cloth within so much [m] more; a collar that
#: lies on it is so far around [m].
_OVER, _DOWN, _AROUND = 4.5e-3, 0.03, 0.1
#: The fold of a turned collar [rad], and how stiff its interfacing makes it.
_TURNED, _INTERFACED = math.radians(155.0), EdgeMaking(bending=4.0, width=0.12)
_CREASED = 30.0
#: A gorge begins so far [m] from the shoulder on the neckline; what is on either side of the neck at lapels.
_GORGE, _TURNED_PARTS = 0.06, ("lapel", "stand", "fall")
#: The angle of a seam of quilting [rad], and the shortest one [m]; points of a side that tell where it ends.
_QUILTED, _SHORTEST_LINE, _FINE = math.radians(110.0), 0.05, 512
#: A fall is by this share longer at its outer edge; it is placed so far [m] outside of its stand, and begins so far [m] from
#: the middle of the front.
_SPREAD, _OUTSIDE, _FROM_MIDDLE = 0.3, 0.015, 0.012


def open_front(t: Table, front: str, *names: str, every: float | None = None) -> None:
    """Panels across the middle as two, ``left_`` and ``right_``, closed there by ``front`` ("buttons", "zip"), with buttons
    ``every`` so many metres."""
    if front == "closed":
        return
    fastener = CLOSURES[front] if every is None else replace(CLOSURES[front], every=every)
    for name in names:
        _divide(t, name, fastener, _PLACKETS[front])


def _divide(t: Table, name: str, fastener: Fastener, placket: EdgeMaking) -> None:
    panel, keys = t.panels.pop(name), t.sides.pop(name)
    starts = np.array([edge.start for edge in panel.edges])
    ends = np.flatnonzero(np.abs(starts[:, 0]) < _MIDDLE)
    low, high = ends[np.argsort(starts[ends, 1])]
    count = len(keys)
    moved: dict[tuple[str, int], tuple[str, int]] = {}
    for side, first, last in (("left", low, high), ("right", high, low)):
        own = [(first + k) % count for k in range((last - first) % count)]
        cut = Edge(starts[last], starts[first], np.zeros((0, 2)), making=placket)
        edges, other = (*(panel.edges[k] for k in own), cut), f"{side}_{name}"
        t.panels[other] = replace(panel, name=other, edges=edges, numbers=tuple(range(len(edges))))
        t.sides[other] = [*(keys[k] for k in own), f"{side}_opening"]
        moved |= {(name, k): (other, place) for place, k in enumerate(own)}
    t.stitches = [_moved(stitch, moved) for stitch in t.stitches]
    both = [(other, len(t.sides[other]) - 1) for other in (f"left_{name}", f"right_{name}")]
    t.stitches.append(Stitch(both[0], both[1], fastener=fastener))


def stand(t: Table, m: Measures, height: float, raised: float = 0.0, apart: float = 0.0) -> None:
    """The stand of a collar, two strips on the neckline that begin ``raised`` [m] above it; its upper edge in front is divided
    so far [m] from the middle."""
    for back in (False, True):
        name = "back" if back else "front"
        below = t.keys(name, "neck")
        lengths = t.lengths(below)
        above = [lengths[0] - apart, apart, apart, lengths[1] - apart] if apart and not back else lengths
        draw_strip(t, f"collar_{name}", above, lengths, height, m.neck_height + raised, _beside_neck(m, back))
        t.sew_all(below, t.keys(f"collar_{name}", "below"))
    t.sew_keys("collar_front", "collar_back", ["side"])


def _beside_neck(m: Measures, back: bool, far: float = 0.1) -> tuple[Place, Place]:
    angles, at = trunk_place(m, back)
    return angles, (at[0], at[1], m.shoulder[2] + (-far if back else far))


class _Arc(NamedTuple):
    """A curve from the middle to the left of the body."""

    start: XY
    curve: tuple[XY, ...]
    end: XY


def _rings(length: float, wide: float, top: float) -> tuple[_Arc, _Arc]:
    """The fold of a quarter of a fall, as long as that, and its outer edge: arcs around a point above the middle."""
    radius = wide / _SPREAD
    angle, found = length / radius, []
    top -= 0.5 * radius * (1.0 - math.cos(angle))
    for own in (radius, radius + wide):
        reach = 4.0 / 3.0 * math.tan(0.25 * angle) * own
        corner = own * math.sin(angle), top + radius - own * math.cos(angle)
        curve = (reach, top + radius - own), (corner[0] - reach * math.cos(angle), corner[1] - reach * math.sin(angle))
        found.append(_Arc((0.0, top + radius - own), curve, corner))
    return found[0], found[1]


def turned_collar(t: Table, m: Measures, height: float, fall: float, point: float) -> None:
    """A stand of that height [m] and its fall, ``fall`` [m] wide behind and ``point`` [m] at its front ends, which is sewn on
    turned down."""
    stand(t, m, height, fall, _FROM_MIDDLE)
    top, far = m.neck_height + fall + height, 0.1 + _OUTSIDE
    above = {back: t.keys(f"collar_{'back' if back else 'front'}", "above") for back in (False, True)}
    fold, outer = _rings(t.lengths(above[True])[1], fall, top)
    half = [Side("outer", outer.start, outer.curve), Side("side", outer.end), Side("fold", fold.end, fold.curve[::-1])]
    t.draw("fall_back", both_halves(half, fold.start, True), *_beside_neck(m, True, far))
    fold, outer = _rings(t.lengths(above[False])[3], fall, top)
    low = (_FROM_MIDDLE + 0.01, top - point)
    way = np.array(outer.end) - outer.curve[1]
    bend = np.array(outer.end) - 0.5 * way * np.linalg.norm(np.array(outer.end) - low) / np.linalg.norm(way)
    half = [
        Side("outer", low, ((float(bend[0]), float(bend[1])),)),
        Side("side", outer.end),
        Side("fold", fold.end, fold.curve[::-1]),
    ]
    t.draw("left_fall", [*half, Side("end", fold.start)], *_beside_neck(m, False, far))
    t.mirror("left_fall", "right_fall")
    folds = zip(
        [above[False][0], above[False][3], *above[True]],
        [("right_fall", "fold"), ("left_fall", "fold"), *t.keys("fall_back", "fold")],
        strict=True,
    )
    _turn_down(t, list(folds))
    for side in ("left", "right"):
        t.sew((f"{side}_fall", "side"), ("fall_back", f"{side}_side"))
    _interface(t, "collar_front", "collar_back", "left_fall", "right_fall", "fall_back")


def ribbed(t: Table, factor: float, *names: str) -> None:
    """Panels of ribbing, at rest ``factor`` times as long along x as they are cut, but never longer."""
    for name in names:
        t.panels[name] = replace(t.panels[name], elastic=(min(float(factor), 1.0), 1.0))


def lapels(t: Table, m: Measures, wide: float, fall: float) -> None:
    """Lapels of that width [m] at a neckline that is a V, a collar with a fall of ``fall`` [m], and a notch between the two."""
    height = 0.03
    back = t.keys("back", "neck")
    own = t.lengths(back)
    draw_strip(t, "collar_back", own, own, height, m.neck_height + fall, _beside_neck(m, True))
    t.sew_all(back, t.keys("collar_back", "below"))
    fold, outer = _rings(own[1], fall, m.neck_height + fall + height)
    half = [Side("outer", outer.start, outer.curve), Side("side", outer.end), Side("fold", fold.end, fold.curve[::-1])]
    t.draw("fall_back", both_halves(half, fold.start, True), *_beside_neck(m, True, 0.1 + _OUTSIDE))
    neck = t.panels["front"].edges[t.sides["front"].index("left_neck")]
    _cut_neck(t, _GORGE / neck.length)
    _draw_lapel(t, m, neck.start, neck.end, (wide, fall, height))
    folds = [(("collar_back", f"above{k}"), other) for k, other in enumerate(t.keys("fall_back", "fold"))]
    for side in ("left", "right"):
        t.sew((f"{side}_stand", "below"), ("front", f"{side}_neck_upper"))
        t.sew((f"{side}_stand", "side"), ("collar_back", f"{side}_side"))
        t.sew((f"{side}_lapel", "gorge"), (f"{side}_fall", "gorge"))
        t.sew((f"{side}_fall", "side"), ("fall_back", f"{side}_side"))
        folds += [((f"{side}_stand", "above"), (f"{side}_fall", "fold"))]
        folds += [(("front", f"{side}_neck_lower"), (f"{side}_lapel", "roll"))]
    _turn_down(t, folds)
    _interface(t, "collar_back", "fall_back", *(f"{side}_{part}" for side in ("left", "right") for part in _TURNED_PARTS))


def _draw_lapel(t: Table, m: Measures, top: np.ndarray, low: np.ndarray, size: tuple[float, float, float]) -> None:
    """Lapel, stand and fall on the neckline of the left front from ``top`` to ``low`` (2,), and their mirror images; ``size``
    is the width of the lapel, that of the fall, and the height of the stand [m]."""
    wide, fall, height = size
    down = (low - top) / np.linalg.norm(low - top)
    out = np.array([-down[1], down[0]])  # away from the middle
    begin = top + _GORGE * down
    notch, tip = begin + 0.55 * wide * out, begin + wide * out - 0.01 * down
    bend = low + 0.45 * (tip - low) + 0.025 * out
    angles, at = trunk_place(m, False)
    flat, over = (angles, at), (angles, (at[0], at[1], at[2] + _OUTSIDE))
    lapel = [Side("outer", _xy(low), (_xy(bend),)), Side("tip", _xy(tip)), Side("gorge", _xy(notch)), Side("roll", _xy(begin))]
    t.draw("left_lapel", lapel, *over)
    t.draw("left_stand", [Side("below", _xy(begin)), Side("side", _xy(top)), Side("above", _xy(top - height * out))], *flat)
    upper = begin - math.hypot(_GORGE, height) * down
    side, end = upper + fall * _turned_by(out, 0.35), notch + 0.6 * fall * _turned_by(-down, -0.45)
    sides = [Side("gorge", _xy(begin)), Side("end", _xy(notch)), Side("outer", _xy(end)), Side("side", _xy(side))]
    t.draw("left_fall", [*sides, Side("fold", _xy(upper))], *over)
    for part in _TURNED_PARTS:
        t.mirror(f"left_{part}", f"right_{part}")


def _turned_by(way: np.ndarray, angle: float) -> np.ndarray:
    """A direction (2,) turned counter-clockwise by an angle [rad]."""
    return np.array([way[0] * math.cos(angle) - way[1] * math.sin(angle), way[0] * math.sin(angle) + way[1] * math.cos(angle)])


def _xy(point: np.ndarray) -> XY:
    return float(point[0]), float(point[1])


def _cut_neck(t: Table, share: float) -> None:
    """The straight necklines of the front in two at a share of them from the shoulder, ``neck_upper`` and ``neck_lower``."""
    for side in ("left", "right"):
        panel, keys = t.panels["front"], t.sides["front"]
        place = keys.index(f"{side}_neck")
        own = panel.edges[place]
        middle = own.at(np.array([share if side == "left" else 1.0 - share]))[0]
        parts = replace(own, end=middle), replace(own, start=middle)
        names = [f"{side}_neck_upper", f"{side}_neck_lower"][:: 1 if side == "left" else -1]
        edges = (*panel.edges[:place], *parts, *panel.edges[place + 1 :])
        t.panels["front"] = replace(panel, edges=edges, numbers=tuple(range(len(edges))))
        t.sides["front"] = [*keys[:place], *names, *keys[place + 1 :]]
        moved = {("front", k): ("front", k + 1) for k in range(place + 1, len(keys))}
        t.stitches = [_moved(stitch, moved) for stitch in t.stitches]


def _moved(stitch: Stitch, moved: Mapping[tuple[str, int], tuple[str, int]]) -> Stitch:
    """A stitch of sides that have other places now."""
    return replace(stitch, first=moved.get(stitch.first, stitch.first), second=moved.get(stitch.second, stitch.second))


def _turn_down(t: Table, folds: Sequence[tuple[SideKey, SideKey]]) -> None:
    """Sides that stand and those that are turned down from them, sewn with a fold."""
    for standing, turned in folds:
        t.sew(standing, turned, same=True)
        t.stitches[-1] = replace(t.stitches[-1], angle=-_TURNED, bending=_CREASED)


def _interface(t: Table, *names: str) -> None:
    for name in names:
        panel = t.panels[name]
        t.panels[name] = replace(panel, edges=tuple(replace(edge, making=_INTERFACED) for edge in panel.edges))


def quilted(t: Table, height: float, *names: str) -> None:
    """Panels with level seams so far [m] from each other, at one height in all of them, which stand in: the cloth between two
    is a tube. They are as far as can be from the corners of the panels."""
    corners = np.unique([edge.start[1] for name in names for edge in t.panels[name].edges])
    ways = [np.arange(corners[0] + share * height, corners[-1], height) for share in np.linspace(0.5, 1.5, 41)]
    levels = max(ways, key=lambda way: float(np.abs(way[:, None] - corners).min()))
    for name in names:
        panel, folds = t.panels[name], []
        outline = np.concatenate([edge.evenly(_FINE)[:-1] for edge in panel.edges])
        after = np.roll(outline, -1, axis=0)
        for level in levels:
            through = (outline[:, 1] < level) != (after[:, 1] < level)
            share = (level - outline[through, 1]) / (after[through, 1] - outline[through, 1])
            ends = np.sort(outline[through, 0] + share * (after[through, 0] - outline[through, 0]))
            for left, right in zip(ends[::2], ends[1::2], strict=True):
                if right - left > _SHORTEST_LINE:
                    folds.append(Fold(np.array([left, level]), np.array([right, level]), -_QUILTED, _CREASED))
        t.panels[name] = replace(panel, folds=tuple(folds))


def opened(sheet: PatternSheet, worn: np.ndarray) -> tuple[PatternSheet, np.ndarray, np.ndarray]:
    """The sheet cut open along what closes it, with its ``rows`` and ``rims``, and cloth below the edges that overlap.

    Args:
        worn: (V, 3) m, where its vertices are.

    Returns:
        That sheet; where its vertices are, one edge lifted off the other; and for each the vertex (of V) that it was, or that
        is next to it.
    """
    _, welds = np.unique(topology.connected_components(len(sheet.uv), sheet.joins), return_inverse=True)
    before = np.zeros(int(welds.max()) + 1, dtype=np.int64)
    before[welds] = sheet.welds
    rows: dict[str, np.ndarray] = {}
    for name in dict.fromkeys(fastener.row for fastener, _ in sheet.fastened):
        own = [(fastener.every, welds[points]) for fastener, points in sheet.fastened if fastener.row == name]
        rows[name] = _spaced(np.concatenate([both for _, both in own]), sheet.pos[before], own[0][0])
    rims = _two(np.concatenate([welds[points] for _, points in sheet.fastened]))
    number = np.arange(len(before))
    number[rims[:, 1]] = rims[:, 0]
    pos = worn[before]
    lifted = pos + _lift(sheet, welds, pos)
    cut = replace(
        sheet,
        pos=sheet.pos[before],
        faces=welds[sheet.uv_faces],
        seam=sheet.seam[before],
        edge_labels={name: own[before] for name, own in sheet.edge_labels.items()},
        stiffness=None if sheet.stiffness is None else sheet.stiffness[before],
        rows=rows,
        rims=rims,
        closed=number[welds[sheet.uv_faces]],
    )
    return _with_underlaps(sheet, worn, welds, before, cut, lifted)


def _two(pairs: np.ndarray) -> np.ndarray:
    """Each of the pairs (N, 2) once, if it is of two vertices."""
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)


def _spaced(pairs: np.ndarray, pos: np.ndarray, every: float) -> np.ndarray:
    """Those of the pairs (N, 2) of vertices ``pos`` (V, 3) [m] that are fastened, from the top down, ``every`` so many metres;
    of 0 all. The lowest button is half of that above the end or more."""
    pairs = _two(pairs)
    middle = pos[pairs].mean(axis=1)
    order = np.argsort(-middle[:, 1], kind="stable")
    pairs, middle = pairs[order], middle[order]
    if not every:
        return pairs
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(middle, axis=0), axis=1))])
    wanted = np.arange(0.0, max(way[-1] - 0.5 * every, 1e-9), every)
    return np.asarray(pairs[np.unique(np.abs(way - wanted[:, None]).argmin(axis=1))])


def _panel_of(sheet: PatternSheet, points: np.ndarray) -> np.ndarray:
    """(F,) bool: the panel that points of ``uv`` are of."""
    return next(own for own in sheet.panels.values() if np.isin(points[0], sheet.uv_faces[own]))


def _lift(sheet: PatternSheet, welds: np.ndarray, pos: np.ndarray) -> np.ndarray:
    """(N, 3) m by which vertices at ``pos`` (N, 3) of the sheet cut open, those of ``uv`` as ``welds`` says, are lifted off
    what will lie below them: those of the first edge, and all near to it on its side."""
    lift, faces = np.zeros_like(pos), welds[sheet.uv_faces]
    edges = topology.unique_edges(faces)
    long = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    graph = coo_matrix((long, edges.T), shape=(len(pos), len(pos)))
    for fastener, points in sheet.fastened:
        if not fastener.overlap:
            continue
        own, other = _panel_of(sheet, points[:, 0]), _panel_of(sheet, points[:, 1])
        chain, reach = welds[points[:, 0]], fastener.overlap + _DOWN
        far = dijkstra(graph, directed=False, indices=np.unique(chain), min_only=True, limit=reach + _AROUND)
        near = np.isfinite(far)
        near[faces[other]] = False
        share = np.linspace(0.0, 1.0, 9)[:, None, None]
        line = ((1.0 - share) * pos[chain[:-1]] + share * pos[chain[1:]]).reshape(-1, 3)
        normals = geometry.vertex_normals(torch.as_tensor(pos), torch.as_tensor(faces[own])).numpy()
        distance, nearest = cKDTree(line).query(pos)
        high = _OVER * np.clip((reach - distance) / _DOWN, 0.0, 1.0) * near
        new = high[:, None] * normals[chain[nearest % (len(chain) - 1)]]
        lift = np.where((np.linalg.norm(new, axis=1) > np.linalg.norm(lift, axis=1))[:, None], new, lift)
    return lift


def _below(sheet: PatternSheet, fastener: Fastener, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (count, N, 3) and weights of the places under the first edge at ``count`` depths from each of its N points."""
    own, line = _panel_of(sheet, points[:, 0]), sheet.uv[points[:, 0]]
    way = np.gradient(line, axis=0)
    inwards = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(way, axis=1, keepdims=True)
    centres = sheet.flat[own].mean(axis=1)
    nearest = cKDTree(line).query(centres)[1]
    inwards *= np.sign(((centres - line[nearest]) * inwards[nearest]).sum())
    depth = fastener.overlap * np.arange(1, count + 1) / count
    places = (line + depth[:, None, None] * inwards).reshape(-1, 2)
    face, weights = in_triangles(places, sheet.flat[own])
    shape = count, len(line), 3
    return sheet.faces[own][face].reshape(shape), weights.reshape(shape)


def _with_underlaps(
    sheet: PatternSheet, worn: np.ndarray, welds: np.ndarray, before: np.ndarray, cut: PatternSheet, pos: np.ndarray
) -> tuple[PatternSheet, np.ndarray, np.ndarray]:
    """:func:`opened` with a strip of cloth at each second edge that lies under the first."""
    overlapping = [(fastener, points) for fastener, points in sheet.fastened if fastener.overlap]
    numbers: dict[tuple[int, int], int] = {}
    at: list[tuple[int, np.ndarray, np.ndarray]] = []
    uv, uv_faces, faces, panels = [sheet.uv], [sheet.uv_faces], [cut.faces], dict(cut.panels)
    used = {tuple(pair) for pair in cut.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()}
    edge = [np.linalg.norm(np.diff(sheet.uv[points[:, 0]], axis=0), axis=1).mean() for _, points in overlapping]
    for fastener, points in overlapping:
        count = max(1, round(fastener.overlap / float(np.mean(edge))))
        roots, (corners, weights) = welds[points[:, 1]], _below(sheet, fastener, points, count)
        table = np.zeros((count + 1, len(roots)), dtype=np.int64)
        table[0] = roots
        for k, j in np.ndindex(count, len(roots)):
            number = numbers.setdefault((int(roots[j]), k), len(before) + len(numbers))
            table[k + 1, j] = number
            at.append((number - len(before), corners[k, j], weights[k, j]))
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(sheet.uv[points[:, 1]], axis=0), axis=1))])
        x, y = np.meshgrid(fastener.overlap * np.arange(count + 1) / count, way[-1] - way, indexing="ij")
        first = sum(len(one) for one in uv)
        own = _strip(count, len(roots), (int(roots[0]), int(roots[1])) in used)
        uv.append(np.stack([x.reshape(-1) + max(float(one[:, 0].max()) for one in uv) + _APART, y.reshape(-1)], axis=1))
        uv_faces.append(first + own)
        faces.append(table.reshape(-1)[own])
        name = f"{fastener.row}_underlap{len(uv) - 1}"
        panels[name] = np.concatenate(
            [np.zeros(sum(len(one) for one in faces[:-1]), dtype=bool), np.ones(len(own), dtype=bool)]
        )
    total = sum(len(one) for one in faces)
    panels = {name: np.pad(own, (0, total - len(own))) for name, own in panels.items()}
    more, tips = total - len(cut.faces), len(numbers)
    roots = np.array([root for root, _ in numbers], dtype=np.int64)
    new = [np.zeros((tips, 3)), np.zeros((tips, 3))]
    hits = np.bincount([number for number, _, _ in at], minlength=tips)[:, None]
    for table3, own3 in zip(new, (worn, sheet.pos), strict=True):
        for number, corner, weight in at:
            table3[number] += weight @ own3[corner] / hits[number]
    flaps = replace(
        cut,
        pos=np.concatenate([cut.pos, new[1]]),
        faces=np.concatenate(faces),
        uv=np.concatenate(uv),
        uv_faces=np.concatenate(uv_faces),
        panels=panels,
        outline=np.pad(cut.outline, (0, sum(len(one) for one in uv[1:])), constant_values=np.nan),
        seam=np.pad(cut.seam, (0, tips)),
        edge_labels={name: np.pad(own, (0, tips)) for name, own in cut.edge_labels.items()},
        made=_more_sides(cut.made, cut.faces, roots, more),
        stiffness=None if cut.stiffness is None else np.concatenate([cut.stiffness, cut.stiffness[roots]]),
    )
    return flaps, np.concatenate([pos, new[0]]), np.concatenate([before, before[roots]])


def _strip(count: int, length: int, flipped: bool) -> np.ndarray:
    """Triangles of ``count`` rows of squares, each with ``length`` points on either side."""
    number = np.arange((count + 1) * length).reshape(count + 1, length)
    a, b, c, d = (part.reshape(-1) for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)])
    return faces[:, ::-1] if flipped else faces


def _more_sides(made: Construction, faces: np.ndarray, roots: np.ndarray, more: int) -> Construction:
    """The same with so many faces more, as stiff as the edge with the vertices ``roots``."""
    tables = {}
    for name, table in vars(made).items():
        nothing = SIDE_TABLES[name]
        if table is not None and name == "bending" and len(roots):
            nothing = float(table[np.isin(faces, roots).any(axis=1)].max())
        tables[name] = None if table is None else np.pad(table, ((0, more), (0, 0)), constant_values=nothing)
    return Construction(**tables)
