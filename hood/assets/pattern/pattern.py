"""Sewing patterns in the format of GarmentCode (``specification.json``): flat panels, and which of their edges are sewn.

Lengths are metres here, whatever the unit of the file; y is up, z forward, and the origin is on the floor under the body.

A key ``hood`` of panels, edges and sides of stitches says how they are made, which the format has no words for: elastic, folds,
and how stiff seams and hems are.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.atomic import write_atomically
from hood.assets.files.guarded import check_size
from hood.assets.pattern.making import (
    EdgeMaking,
    Fastener,
    Fold,
    edge_making,
    in_centimetres,
    panel_making,
    stitch_making,
    written,
)
from hood.assets.pattern.riding import Patch, patches_of, written_patches

#: Two edges that are sewn may differ in length by this factor: gathers of generated patterns reach 2.2.
MOST_GATHERED = 4.0
#: Height [m] of the body that patterns are placed around that do not say.
BODY_HEIGHT = 1.72
#: What a seam of three layers is for, and how it is had.
LINING = "a lining is a garment of its own, worn below, garment=[lining.npz,skirt.npz] of hood rollout"
#: Drawings: DXF, also by the rules of AAMA and ASTM, and SVG.
_DRAWINGS = (".dxf", ".svg")
#: A panel whose middle is so far to the side [m] and so high [m] is one of a sleeve.
_BESIDE, _HIGH = 0.19, 0.9
#: Points of a curve that measure its length and find where outlines cross.
_POINTS = 33
#: Edges shorter than this [m] are none. A pattern has units of at most so many metres.
_SHORTEST, _SIZE_LIMIT = 1e-4, 64 << 20


@dataclass(frozen=True)
class Edge:
    """A side of a panel, from ``start`` to ``end`` (2,) [m], straight or curved.

    Args:
        curve: control points (n, 2) [m] of a Bézier curve between the ends; n is 0 for a straight side.
        arc: radius [m], whether the long way round, and whether it bulges to the right of the way; None: no arc.
    """

    start: np.ndarray
    end: np.ndarray
    curve: np.ndarray
    arc: tuple[float, bool, bool] | None = None
    label: str = ""
    making: EdgeMaking = EdgeMaking()

    def at(self, share: np.ndarray) -> np.ndarray:
        """Points (N, 2) [m] at shares (N,) of the parameter."""
        if self.arc is not None:
            return self._on_arc(share)
        points = np.concatenate([self.start[None], self.curve, self.end[None]])
        table = np.repeat(points[None], len(share), axis=0)
        t = share[:, None, None]
        while table.shape[1] > 1:  # de Casteljau
            table = (1.0 - t) * table[:, :-1] + t * table[:, 1:]
        return np.asarray(table[:, 0])

    def _on_arc(self, share: np.ndarray) -> np.ndarray:
        assert self.arc is not None
        radius, large, right = self.arc
        way = self.end - self.start
        half = 0.5 * float(np.linalg.norm(way))
        radius = max(radius, half)
        left = np.array([-way[1], way[0]]) / (2.0 * half)
        # The centre of the short arc is opposite to its bulge.
        side = (1.0 if right else -1.0) * (-1.0 if large else 1.0)
        centre = 0.5 * (self.start + self.end) + side * np.sqrt(max(radius**2 - half**2, 0.0)) * left
        first, last = (np.arctan2(*(point - centre)[::-1]) for point in (self.start, self.end))
        turn = (last - first) % (2.0 * np.pi)  # counter-clockwise, which bulges to the right
        turn = turn if right else turn - 2.0 * np.pi
        angle = first + share * turn
        points = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points[share == 0.0], points[share == 1.0] = self.start, self.end
        return np.asarray(points)

    def evenly(self, count: int) -> np.ndarray:
        """Points (count + 1, 2) [m] at equal lengths along the side, its ends among them."""
        return self.along(np.linspace(0.0, 1.0, count + 1))

    def along(self, shares: np.ndarray) -> np.ndarray:
        """Points (N, 2) [m] at shares (N,) of the length."""
        fine = self.at(np.linspace(0.0, 1.0, 8 * max(len(shares) - 1, _POINTS) + 1))
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
        return np.stack([np.interp(way[-1] * shares, way, fine[:, axis]) for axis in (0, 1)], axis=1)

    @cached_property
    def length(self) -> float:
        """Length [m] along the curve."""
        return float(np.linalg.norm(np.diff(self.at(np.linspace(0.0, 1.0, 4 * _POINTS)), axis=0), axis=1).sum())


@dataclass(frozen=True)
class PatternPanel:
    """A flat piece of cloth, and where its maker puts it around the body.

    Args:
        edges: one closed loop, in its order; ``numbers`` are theirs in the file.
        rotation: (3, 3).
        translation: (3,) m.
        elastic: how many times as long it is at rest as it is cut, along x and along y.
        patches: pockets, buttons and the like, which ride on it.
    """

    name: str
    edges: tuple[Edge, ...]
    numbers: tuple[int, ...]
    rotation: np.ndarray
    translation: np.ndarray
    label: str = ""
    elastic: tuple[float, float] = (1.0, 1.0)
    folds: tuple[Fold, ...] = ()
    patches: tuple[Patch, ...] = ()

    def placed(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) m in space of points (N, 2) of the panel."""
        return np.asarray(np.pad(points, ((0, 0), (0, 1))) @ self.rotation.T + self.translation)


@dataclass(frozen=True)
class Stitch:
    """Two edges, as (panel, place in its loop), that are sewn; ``same``: they run in one direction, not against each other.
    The cloth is folded there by ``angle`` [rad], seen from the first, where that is not None, and bends ``bending`` times as
    stiffly. With a ``fastener`` it is opened once it is sewn, and closed by that."""

    first: tuple[str, int]
    second: tuple[str, int]
    same: bool = False
    angle: float | None = None
    bending: float = 1.0
    fastener: Fastener | None = None


@dataclass(frozen=True)
class Pattern:
    """Panels by name and their stitches; ``height`` [m] is that of the body around which they are placed."""

    name: str
    panels: Mapping[str, PatternPanel]
    stitches: tuple[Stitch, ...]
    height: float = BODY_HEIGHT

    @property
    def sleeved(self) -> bool:
        """Whether a panel is one of a sleeve, by its label or its place."""
        for panel in self.panels.values():
            middle = panel.placed(np.array([edge.start for edge in panel.edges])).mean(axis=0)
            if panel.label == "arm" or (abs(middle[0]) > _BESIDE and middle[1] > _HIGH):
                return True
        return False

    def told(self, number: int) -> str:
        """A stitch in words, with the numbers of the file."""
        sides = (self.stitches[number].first, self.stitches[number].second)
        edges = (f"{name!r} edge {self.panels[name].numbers[place]}" for name, place in sides)
        return f"stitch {number} ({' and '.join(edges)})"


def read_pattern(path: Path, most_gathered: float = MOST_GATHERED) -> Pattern:
    """The pattern in a file, checked.

    Args:
        most_gathered: two edges that are sewn may differ in length by this factor.

    Raises:
        ValueError: not such a file, or a pattern that cannot be sewn: an outline that is not closed or crosses itself, an edge
            without length, a stitch to nothing, an edge in two stitches, lengths that differ too much. One sentence names the
            file, the panel, the edge and the repair.

    Examples:
        >>> from hood.assets.pattern.pattern import read_pattern
        >>> pattern = read_pattern("specification.json")  # doctest: +SKIP
        >>> sorted(pattern.panels)  # doctest: +SKIP
        ['back', 'front']
    """
    path = Path(path)
    check_size(path, _SIZE_LIMIT)
    if path.suffix.lower() in _DRAWINGS:
        kind = path.suffix[1:].upper()
        raise ValueError(
            f"{path}: {kind} files draw outlines and do not say what is sewn to what; give a GarmentCode specification.json"
        )
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not JSON ({str(error).splitlines()[0]}); give a GarmentCode specification.json") from None
    table = content.get("pattern") if isinstance(content, dict) else None
    if not (isinstance(table, dict) and isinstance(table.get("panels"), dict) and table["panels"]):
        raise ValueError(f"{path}: no pattern.panels; give a GarmentCode specification.json")
    properties = content.get("properties") if isinstance(content.get("properties"), dict) else {}
    units = properties.get("units_in_meter", 100)
    if isinstance(units, bool) or not isinstance(units, (int, float)) or not 0.1 <= units <= 1e4:
        raise ValueError(f"{path}: properties.units_in_meter is {units!r}; write 100 for centimetres")
    panels = {name: _panel(f"{path}: panel {name!r}", name, own, 1.0 / units) for name, own in table["panels"].items()}
    stitches = table.get("stitches", [])
    if not isinstance(stitches, list):
        raise ValueError(f"{path}: pattern.stitches is no list; write [[{{panel, edge}}, {{panel, edge}}], …]")
    found = tuple(_stitch(f"{path}: stitch {number}", own, panels, 1.0 / units) for number, own in enumerate(stitches))
    height = float(_numbers(f"{path}: properties.body_height", properties.get("body_height", BODY_HEIGHT * units), ())) / units
    if not 0.3 <= height <= 3.0:
        raise ValueError(f"{path}: properties.body_height is {height:g} m; give the height of the body, in the file's unit")
    pattern = Pattern(path.parent.name if path.stem == "specification" else path.stem, panels, found, height)
    _check_stitches(str(path), pattern, most_gathered)
    return pattern


def _numbers(where: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    fits = array.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        form = " × ".join("n" if size < 0 else str(size) for size in shape)
        raise ValueError(f"{where} is not {form} finite numbers; repair it")
    return array


def _panel(where: str, name: str, own: Any, scale: float) -> PatternPanel:
    if not isinstance(own, dict) or not isinstance(own.get("edges"), list):
        raise ValueError(f"{where} has no edges; write vertices and edges of its outline, or remove it")
    vertices = scale * _numbers(f"{where}: vertices", own.get("vertices"), (-1, 2))
    ends = []
    for number, edge in enumerate(own["edges"]):
        pair = edge.get("endpoints") if isinstance(edge, dict) else None
        whole = isinstance(pair, list) and len(pair) == 2 and all(type(end) is int and 0 <= end < len(vertices) for end in pair)
        if not whole or pair is None:
            raise ValueError(
                f"{where}, edge {number}: endpoints are {pair}; give two numbers of vertices below {len(vertices)}"
            )
        ends.append(tuple(pair))
    edges, numbers = [], _loop(where, ends)
    for number in numbers:
        edge, there = own["edges"][number], f"{where}, edge {number}"
        start, end = vertices[list(ends[number])]
        plain = _edge(there, edge, start, end, scale)
        edges.append(replace(plain, making=edge_making(there, edge, scale)))
        if edges[-1].length < _SHORTEST:
            raise ValueError(f"{there} has no length; merge its two vertices")
    _check_outline(where, edges, numbers)
    angles = _numbers(f"{where}: rotation", own.get("rotation", [0, 0, 0]), (3,))
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    translation = scale * _numbers(f"{where}: translation", own.get("translation", [0, 0, 0]), (3,))
    elastic, folds = panel_making(where, own, scale)
    patches, label = patches_of(where, own.get("hood", {}), scale), str(own.get("label", ""))
    return PatternPanel(name, tuple(edges), tuple(numbers), turn, translation, label, elastic, folds, patches)


def _loop(where: str, ends: list[tuple[int, int]]) -> list[int]:
    """Numbers of the edges along the outline."""
    after = {start: number for number, (start, _) in enumerate(ends)}
    if len(ends) < 2 or len(after) != len(ends):
        number = next((n for n, (start, _) in enumerate(ends) if after[start] != n), 0)
        raise ValueError(f"{where}, edge {number}: the outline is no loop there; let every edge begin where another one ends")
    order = [0]
    while len(order) <= len(ends):
        end = ends[order[-1]][1]
        if end not in after:
            raise ValueError(f"{where}, edge {order[-1]}: no edge begins at its end, vertex {end}; close the outline")
        if after[end] == 0:
            break
        order.append(after[end])
    if len(order) != len(ends):
        other = next(number for number in range(len(ends)) if number not in order)
        raise ValueError(f"{where}, edge {other} is not on the outline of edge 0; holes are not read, cut the panel open")
    return order


def _edge(where: str, edge: Mapping[str, Any], start: np.ndarray, end: np.ndarray, scale: float) -> Edge:
    given, label = edge.get("curvature"), str(edge.get("label", ""))
    none = np.zeros((0, 2))
    if given is None:
        return Edge(start, end, none, None, label)
    kind, params = ("quadratic", [given]) if isinstance(given, list) else (given.get("type"), given.get("params"))
    if kind == "circle":
        radius, large, right = _numbers(f"{where}: params of its circle", params, (3,))
        if not radius > 0:
            raise ValueError(f"{where}: the radius of its circle is {radius:g}; give one above 0")
        return Edge(start, end, none, (scale * float(radius), bool(large), bool(right)), label)
    count = {"quadratic": 1, "cubic": 2}.get(str(kind))
    if count is None:
        raise ValueError(f"{where}: its curvature is of type {kind!r}; give quadratic, cubic or circle")
    shares = _numbers(f"{where}: its control points", params, (count, 2))
    way = end - start
    left = np.array([-way[1], way[0]])
    return Edge(start, end, start + shares[:, :1] * way + shares[:, 1:] * left, None, label)


def _check_outline(where: str, edges: list[Edge], numbers: list[int]) -> None:
    """Raise ValueError where the outline crosses itself."""
    lines = [edge.at(np.linspace(0.0, 1.0, 2 if not len(edge.curve) and edge.arc is None else _POINTS)) for edge in edges]
    a = np.concatenate([line[:-1] for line in lines])
    b = np.concatenate([line[1:] for line in lines])
    owner = np.repeat(np.arange(len(lines)), [len(line) - 1 for line in lines])
    i, j = np.triu_indices(len(a), 2)
    near = ~((i == 0) & (j == len(a) - 1))
    i, j = i[near], j[near]

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.asarray((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])

    through = (side(a[i], b[i], a[j]) * side(a[i], b[i], b[j]) < 0) & (side(a[j], b[j], a[i]) * side(a[j], b[j], b[i]) < 0)
    if through.any():
        row = int(through.argmax())
        first, second = numbers[owner[i[row]]], numbers[owner[j[row]]]
        raise ValueError(f"{where}: its outline crosses itself, edge {first} and edge {second}; move their vertices apart")


def _stitch(where: str, own: Any, panels: Mapping[str, PatternPanel], scale: float) -> Stitch:
    if not isinstance(own, list) or len(own) not in (2, 3) or not all(isinstance(side, dict) for side in own[:2]):
        raise ValueError(f"{where} is no pair of sides; write [{{panel, edge}}, {{panel, edge}}]")
    if len(own) == 3 and own[2] != "right_wrong":
        raise ValueError(f'{where}: its third entry is {own[2]!r}; write "right_wrong", or leave it out')
    sides: list[tuple[str, int]] = []
    for side in own[:2]:
        name, number = side.get("panel"), side.get("edge")
        if name not in panels:
            raise ValueError(f"{where}: there is no panel {name!r}; remove the stitch, or name one of {', '.join(panels)}")
        if number not in panels[name].numbers:
            count = len(panels[name].edges)
            raise ValueError(
                f"{where}: panel {name!r} has no edge {number}; remove the stitch, or give one of 0 to {count - 1}"
            )
        sides.append((str(name), panels[name].numbers.index(number)))
    return Stitch(sides[0], sides[1], len(own) == 3, *stitch_making(where, own[0], own[1], scale))


def _check_stitches(where: str, pattern: Pattern, most: float) -> None:
    taken: dict[tuple[str, int], int] = {}
    for number, stitch in enumerate(pattern.stitches):
        lengths = []
        for name, place in (stitch.first, stitch.second):
            panel, there = pattern.panels[name], f"{where}: panel {name!r}, edge {pattern.panels[name].numbers[place]}"
            if (name, place) in taken:
                other = taken[name, place]
                raise ValueError(
                    f"{there} is in stitches {other} and {number}; divide the edge, or remove one of them; {LINING}"
                )
            taken[name, place] = number
            lengths.append(panel.edges[place].length)
        if max(lengths) > most * min(lengths):
            sides = " and ".join(
                f"panel {name!r}, edge {pattern.panels[name].numbers[place]} ({1e2 * length:.1f} cm)"
                for (name, place), length in zip((stitch.first, stitch.second), lengths, strict=True)
            )
            raise ValueError(f"{where}: stitch {number} joins {sides}, more than {most:g} times as long; change one of them")


def check_pattern(where: str, pattern: Pattern, most_gathered: float = MOST_GATHERED) -> None:
    """Raise ValueError, as :func:`read_pattern` does, unless a pattern that was made in memory can be sewn."""
    for name, panel in pattern.panels.items():
        there = f"{where}: panel {name!r}"
        short = next((k for k, edge in enumerate(panel.edges) if edge.length < _SHORTEST), None)
        if short is not None:
            raise ValueError(f"{there}, edge {panel.numbers[short]} has no length; merge its two vertices")
        _check_outline(there, list(panel.edges), list(panel.numbers))
    _check_stitches(where, pattern, most_gathered)


def write_pattern(path: Path, pattern: Pattern) -> None:
    """Write a GarmentCode ``specification.json`` in centimetres, which :func:`read_pattern` reads back.

    Edges stand in the order of the loop; an existing file is replaced at once or not at all.

    Raises:
        ValueError: an edge whose curve has more than two control points, which the format has not.
    """
    panels: dict[str, dict[str, Any]] = {}
    for name, panel in pattern.panels.items():
        edges = [_written(f"{path}: panel {name!r}, edge {k}", k, len(panel.edges), edge) for k, edge in enumerate(panel.edges)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of turns for which several triples of angles stand
            angles = Rotation.from_matrix(panel.rotation).as_euler("xyz", degrees=True)
        panels[name] = {
            "translation": in_centimetres(panel.translation),
            "rotation": [round(float(angle), 10) + 0.0 for angle in angles],
            "vertices": [in_centimetres(edge.start) for edge in panel.edges],
            "edges": edges,
            "label": panel.label,
            **written(panel),
        }
        if panel.patches:
            panels[name]["hood"] = panels[name].get("hood", {}) | written_patches(panel)
    stitches: list[list[Any]] = []
    for stitch in pattern.stitches:
        sides: list[Any] = [{"panel": name, "edge": place} for name, place in (stitch.first, stitch.second)]
        sides[0] |= written(stitch)
        stitches.append([*sides, "right_wrong"] if stitch.same else sides)
    properties = {"units_in_meter": 100, "curvature_coords": "relative", "normalize_panel_translation": False}
    properties["body_height"] = round(100.0 * pattern.height, 10)
    content = {
        "pattern": {"panels": panels, "stitches": stitches, "panel_order": list(panels)},
        "parameters": {},
        "parameter_order": [],
        "properties": {**properties, "normalized_edge_loops": True},
    }
    write_atomically(Path(path), (json.dumps(content, indent=1) + "\n").encode())


def _written(where: str, number: int, count: int, edge: Edge) -> dict[str, Any]:
    content: dict[str, Any] = {"endpoints": [number, (number + 1) % count], **written(edge.making)}
    if edge.arc is not None:
        radius, large, right = edge.arc
        content["curvature"] = {"type": "circle", "params": [100.0 * radius, int(large), int(right)]}
    elif len(edge.curve):
        if len(edge.curve) > 2:
            raise ValueError(f"{where} has {len(edge.curve)} control points; the format has one or two")
        way = edge.end - edge.start
        axes = np.stack([way, [-way[1], way[0]]], axis=1) / float(way @ way)
        params = [[float(value) for value in point] for point in (edge.curve - edge.start) @ axes]
        content["curvature"] = {"type": "quadratic" if len(params) == 1 else "cubic", "params": params}
    if edge.label:
        content["label"] = edge.label
    return content
