"""How the pieces of a pattern are made: elastic, folds, and how stiff seams and hems are; what the key ``hood`` says.

The format of GarmentCode has no words for it. The key stands in panels, edges and sides of stitches, lengths in the unit of the
file, angles in degrees; other programs pass it over:

- a panel: ``"hood": {"elastic": [0.85, 1], "folds": [{"from": [0, 0], "to": [0, 40], "angle": 150}]}``, at rest 0.85 times as
  long along x as it is cut, and folded along a line: beyond 0 away from its outer side, which is where its outline runs
  counter-clockwise; ``"bending"`` of a fold is a factor on the stiffness there;
- an edge: ``"hood": {"elastic": 0.85, "bending": 3, "width": 2}``, the same of the cloth within a width of it, such as a hem;
- a side of a stitch: ``{"panel": "cuff", "edge": 0, "hood": {"angle": 150, "bending": 4}}``, the angle of a seam as its first
  panel sees it, and how stiff its layers are; ``{"fastener": "front_buttons", "every": 8, "overlap": 3}`` is a row of buttons
  so far from each other in its place, without ``every`` a zip: sewn with the other seams, then opened; the second side reaches
  3 below the first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hood.mesh import topology
from hood.mesh.flat import Construction, stretched_sides

if TYPE_CHECKING:
    from hood.assets.pattern.pattern import Pattern, PatternPanel, Stitch
    from hood.assets.pattern.sheet import PatternSheet

#: What elastic and the stiffness of seams may be [factors], and how wide [m] a hem or a band of elastic is that does not say.
ELASTIC, _STIFF, _HEM = (0.2, 2.0), (0.01, 1000.0), 0.02
#: The layers of a seam reach so far [m] on either side of it.
_ALLOWANCE = 0.01
#: A fold is at least so long [m]; what is said of a fastener, and its least [m].
_SHORTEST, _OF_FASTENER, _NEAREST = 1e-4, ("every", "overlap"), 5e-3
#: What a panel says of what rides on it, which :mod:`hood.assets.pattern.riding` reads.
_RIDING = ("patches", "buttons", "radius")
#: Points of a side that tell how much of it is in a band, and points of an edge of the line that the band follows.
_SAMPLES = 9
#: Lengths within this share are one: lines are points here.
_ROUND = 0.01


@dataclass(frozen=True)
class Fold:
    """A line of a panel, ``start`` to ``end`` (2,) [m], along which the cloth is folded by ``angle`` [rad], beyond 0 away from
    its outer side, from where its outline runs counter-clockwise; it bends ``bending`` times as stiffly there."""

    start: np.ndarray
    end: np.ndarray
    angle: float
    bending: float = 1.0


@dataclass(frozen=True)
class EdgeMaking:
    """The cloth within ``width`` [m] of an edge is ``elastic`` times as long along it at rest as it is cut, and bends
    ``bending`` times as stiffly."""

    elastic: float = 1.0
    bending: float = 1.0
    width: float = _HEM


@dataclass(frozen=True)
class Fastener:
    """What closes two edges in the place of a seam: a row of that name, a pair of vertices ``every`` so many metres; of 0 a
    zip, all of them. The second one reaches ``overlap`` [m] below the first."""

    row: str
    every: float = 0.0
    overlap: float = 0.0


def panel_making(where: str, own: Mapping[str, Any], scale: float) -> tuple[tuple[float, float], tuple[Fold, ...]]:
    """Elastic along x and y of a panel, and its folds; ``scale`` [m] is the unit of its lengths.

    Raises:
        ValueError: what cannot be so; names ``where``, the key, the value and the repair. So do the next two.
    """
    made = _made(where, own, ("elastic", "folds", *_RIDING))
    both = made.get("elastic", [1.0, 1.0])
    both = both if isinstance(both, list) else [both, 1.0]
    if len(both) != 2:
        raise ValueError(f"{where}: hood.elastic is {both}; give one factor along x, or two, along x and y, such as [0.85, 1]")
    elastic = _factor(where, "elastic", both[0], ELASTIC), _factor(where, "elastic", both[1], ELASTIC)
    folds = made.get("folds", [])
    if not isinstance(folds, list):
        raise ValueError(f"{where}: hood.folds is no list; write [{{from: [x, y], to: [x, y], angle: 90}}, …]")
    lines = tuple(_fold(f"{where}, fold {number}", fold, scale) for number, fold in enumerate(folds))
    return elastic, lines


def edge_making(where: str, own: Mapping[str, Any], scale: float) -> EdgeMaking:
    """What an edge says."""
    made = _made(where, own, ("elastic", "bending", "width"))
    width = scale * _factor(where, "width", made.get("width", _HEM / scale), (1e-3 / scale, 1.0 / scale))
    elastic = _factor(where, "elastic", made.get("elastic", 1.0), ELASTIC)
    return EdgeMaking(elastic, _factor(where, "bending", made.get("bending", 1.0), _STIFF), width)


def stitch_making(
    where: str, first: Mapping[str, Any], second: Mapping[str, Any], scale: float
) -> tuple[float | None, float, Fastener | None]:
    """The angle [rad] of a seam, None where no side says one, its factor on the stiffness in bending, and what closes it."""
    known = ("angle", "bending", "fastener", *_OF_FASTENER)
    made = _made(where, second, known) | _made(where, first, known)
    angle = _angle(where, made["angle"]) if "angle" in made else None
    bending, row, fastener = _factor(where, "bending", made.get("bending", 1.0), _STIFF), made.get("fastener"), None
    for key in _OF_FASTENER if row is None else ():
        if key in made:
            raise ValueError(f"{where}: hood.{key} is {made[key]!r} without a fastener; name its row, fastener: front_buttons")
    if row is not None:
        if not (isinstance(row, str) and row.isidentifier()):
            raise ValueError(f"{where}: hood.fastener is {row!r}; give the name of a row, such as front_buttons or front_zip")
        limits = _NEAREST / scale, 1.0 / scale
        own = {key: scale * _factor(where, key, made[key], limits) for key in _OF_FASTENER if key in made}
        fastener = Fastener(row, **own)
    return angle, bending, fastener


def written(piece: PatternPanel | EdgeMaking | Stitch | Fold) -> dict[str, Any]:
    """What the key ``hood`` of a panel, an edge or a side of a stitch says, in centimetres; nothing where it is made as any.

    Numbers are rounded to 10 digits: degrees that were read are those that are written.
    """
    made: dict[str, Any] = {}
    for name, value in vars(piece).items():
        if name == "elastic" and value not in (1.0, (1.0, 1.0)):
            made[name] = value if isinstance(value, float) else list(value)
        elif (name == "bending" and value != 1.0) or (name == "width" and value != _HEM):
            made[name] = round(value * (100.0 if name == "width" else 1.0), 10)
        elif name == "angle" and value is not None:
            made[name] = round(float(np.degrees(value)), 10)
        elif name == "folds" and value:
            made[name] = [
                {"from": in_centimetres(fold.start), "to": in_centimetres(fold.end), **written(fold)["hood"]} for fold in value
            ]
        elif name == "fastener" and value is not None:
            made[name] = value.row
            made |= {key: round(100.0 * getattr(value, key), 10) for key in _OF_FASTENER if getattr(value, key)}
    return {"hood": made} if made else {}


def in_centimetres(point: np.ndarray) -> list[float]:
    """A point [m] as it is written: a picometre is less than its rounding."""
    return [round(100.0 * float(value), 10) + 0.0 for value in point]


def _made(where: str, own: Mapping[str, Any], known: tuple[str, ...]) -> dict[str, Any]:
    """What ``hood`` of a panel, an edge or a side of a stitch says."""
    made = own.get("hood", {})
    if not isinstance(made, dict) or not made.keys() <= set(known):
        raise ValueError(f"{where}: hood is {made!r}; give a table of {', '.join(known)}")
    return made


def _factor(where: str, key: str, value: Any, limits: tuple[float, float]) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not limits[0] <= value <= limits[1]:
        raise ValueError(f"{where}: hood.{key} is {value!r}; give a number from {limits[0]:g} to {limits[1]:g}")
    return float(value)


def _angle(where: str, value: Any) -> float:
    """Degrees in the file, radians here."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 180.0:
        raise ValueError(f"{where}: its angle is {value!r}; give degrees between -180 and 180, 0 for flat")
    return float(np.radians(value))


def _fold(where: str, own: Any, scale: float) -> Fold:
    if not isinstance(own, dict) or not {"from", "to", "angle"} <= own.keys() <= {"from", "to", "angle", "bending"}:
        raise ValueError(f"{where} is {own!r}; give from: [x, y], to: [x, y], angle: degrees, and bending: factor if need be")
    start, end = (scale * _point(f"{where}: {key}", own[key]) for key in ("from", "to"))
    if np.linalg.norm(end - start) < _SHORTEST:
        raise ValueError(f"{where} has no length; move its ends apart")
    return Fold(start, end, _angle(where, own["angle"]), _factor(where, "bending", own.get("bending", 1.0), _STIFF))


def _point(where: str, value: Any) -> np.ndarray:
    numbers = isinstance(value, list) and len(value) == 2 and all(type(number) in (int, float) for number in value)
    if not numbers or not np.isfinite(value).all():
        raise ValueError(f"{where} is {value!r}; give a point [x, y]")
    return np.array(value, dtype=np.float64)


def construction_of(
    pattern: Pattern,
    corners: np.ndarray,
    uv: np.ndarray,
    of_panel: np.ndarray,
    outlines: Mapping[tuple[str, int], np.ndarray],
    creases: Mapping[str, list[np.ndarray]],
) -> Construction:
    """What panels, edges and stitches say of how they are made, on the sides of the faces ``corners`` (F, 3) of the pattern."""
    flat = uv[corners]
    edges = flat[:, 1:] - flat[:, :1]
    elastic, bending, fold = np.ones(corners.shape), np.ones(corners.shape), np.full(corners.shape, np.nan)

    def pairs(line: np.ndarray) -> np.ndarray:
        return np.stack([line[:-1], line[1:]], axis=1)

    for number, panel in enumerate(pattern.panels.values()):
        own = of_panel == number
        if panel.elastic != (1.0, 1.0):
            way = np.broadcast_to([1.0, 0.0], (int(own.sum()), 2))
            elastic[own] = stretched_sides(edges[own], way, *panel.elastic)
        for k, side in enumerate(panel.edges):
            making = side.making
            if making != EdgeMaking():
                band = band_along(flat, own, uv[pairs(outlines[panel.name, k])], making.width)
                within = stretched_sides(edges, band.way, making.elastic)
                elastic[band.inside] = within[band.inside] if making.elastic != 1.0 else elastic[band.inside]
                bending = _layered(bending, band.share, making.bending)
        for line, crease in zip(creases[panel.name], panel.folds, strict=True):
            on_it = sides_between(corners, pairs(line))
            fold[on_it], bending = crease.angle, _layered(bending, on_it, crease.bending)
    for stitch in pattern.stitches:
        for name, k in (stitch.first, stitch.second) if stitch.bending != 1.0 else ():
            own = of_panel == list(pattern.panels).index(name)
            band = band_along(flat, own, uv[pairs(outlines[name, k])], _ALLOWANCE)
            bending = _layered(bending, band.share, stitch.bending)
        if stitch.angle is not None:
            fold[sides_between(corners, pairs(outlines[stitch.first]))] = stitch.angle
    return Construction(
        None if (elastic == 1.0).all() else elastic,
        None if np.isnan(fold).all() else fold,
        None if (bending == 1.0).all() else bending,
    )


def _layered(bending: np.ndarray, share: np.ndarray, factor: float) -> np.ndarray:
    """Factors (F, 3) of sides of which ``share`` (F, 3) bend ``factor`` times as stiffly; 1 changes nothing."""
    return bending if factor == 1.0 else np.where(share > 0.0, 1.0 + (factor - 1.0) * share, bending)


def with_elastic(sheet: PatternSheet, rim: np.ndarray, factor: float, width: float, stiffness: float = 1.0) -> PatternSheet:
    """The same with elastic along a rim (V,) bool, ``width`` [m] wide, ``factor`` times as long at rest as the cloth there and
    ``stiffness`` times as stiff."""
    flat = sheet.flat
    elastic = np.ones(sheet.faces.shape) if sheet.made.elastic is None else sheet.made.elastic.copy()
    edges, counts = topology.counted_edges(sheet.faces)
    sides = sides_between(sheet.faces, edges[(counts == 1) & rim[edges].all(axis=1)])
    ends = np.stack([np.roll(flat, -1, axis=1), np.roll(flat, -2, axis=1)], axis=2)
    for own in sheet.panels.values():
        line = ends[own[:, None] & sides]
        if len(line):
            band = band_along(flat, own, line, width)
            elastic[band.inside] = stretched_sides(flat[:, 1:] - flat[:, :1], band.way, factor)[band.inside]
    drawn = replace(sheet, made=replace(sheet.made, elastic=elastic))
    return replace(drawn, stiffness=np.where(drawn.gathered, stiffness, 1.0))


def laid(points: np.ndarray, folds: Sequence[Fold], outer: float) -> np.ndarray:
    """(N, 3) m: points (N, 2) of a panel with its pleats laid, folds that do not cross, one way and back; without, flat.

    Args:
        folds: that run across the panel.
        outer: 1, or -1 for a panel whose outer side is at negative z.
    """
    flat = np.pad(points, ((0, 0), (0, 1)))
    if len({fold.angle > 0.0 for fold in folds}) < 2:
        return flat
    ways = [fold.end - fold.start for fold in folds]
    ways = [way / np.linalg.norm(way) * np.sign(way @ ways[0]) for way in ways]
    across = [np.array([way[1], -way[0]]) for way in ways]
    ends = np.array([(fold.start, fold.end) for fold in folds])
    tips = [(ends - fold.start) @ side for fold, side in zip(folds, across, strict=True)]
    if any(((tip.min(axis=1) < -_SHORTEST) & (tip.max(axis=1) > _SHORTEST)).any() for tip in tips):
        return flat
    beyond = np.stack([(points - fold.start) @ side for fold, side in zip(folds, across, strict=True)], axis=1) > 0.0
    order = np.argsort([fold.start @ across[0] for fold in folds])
    found, turn, shift = flat.copy(), np.eye(3), np.zeros(3)
    for row in order:
        # What lies beyond a fold turns around it, with all folds before.
        own, start = (
            Rotation.from_rotvec(outer * folds[row].angle * np.append(ways[row], 0.0)),
            np.append(folds[row].start, 0.0),
        )
        shift = turn @ (start - own.apply(start)) + shift
        turn = turn @ own.as_matrix()
        found[beyond[:, row]] = flat[beyond[:, row]] @ turn.T + shift
    middles = flat.mean(axis=0), found.mean(axis=0)
    back = Rotation.align_vectors(flat - middles[0], found - middles[1])[0]
    return np.asarray(back.apply(found - middles[1]) + middles[0])


def sides_between(faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """(F, 3) bool: sides whose ends are a pair of vertices (N, 2), in any order."""
    count = int(max(faces.max(initial=-1), pairs.max(initial=-1))) + 1
    ends = np.sort(np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2), axis=2)
    wanted = np.sort(pairs, axis=1)
    return np.asarray(np.isin(ends[..., 0] * count + ends[..., 1], wanted[:, 0] * count + wanted[:, 1]))


class Band(NamedTuple):
    """The cloth within some width of a line.

    ``inside`` (F,) bool, faces by their centre; ``way`` (F, 2) where the line runs, next to it; ``share`` (F, 3) of the sides
    that are inside.
    """

    inside: np.ndarray
    way: np.ndarray
    share: np.ndarray


def band_along(flat: np.ndarray, faces: np.ndarray, line: np.ndarray, width: float) -> Band:
    """The band along a line of edges (N, 2, 2) [m] of ``width`` [m], among ``faces`` (F,) bool with the corners ``flat``
    (F, 3, 2) [m]."""
    longest = float(np.linalg.norm(line[:, 1] - line[:, 0], axis=1).max())
    count = max(_SAMPLES, int(np.ceil(_SAMPLES * longest / width)))
    between = np.linspace(0.0, 1.0, count)[:, None, None]
    points = ((1.0 - between) * line[:, 0] + between * line[:, 1]).reshape(-1, 2)
    ways = np.broadcast_to(line[:, 1] - line[:, 0], (count, len(line), 2)).reshape(-1, 2)
    tree, own = cKDTree(points), flat[faces]
    distance, nearest = tree.query(own.mean(axis=1))
    start, end = np.roll(own, -1, axis=1), np.roll(own, -2, axis=1)
    along = np.concatenate([(1.0 - s) * start + s * end for s in np.linspace(0.0, 1.0, _SAMPLES)], axis=1)
    near = (tree.query(along)[0] <= (1.0 + _ROUND) * width).reshape(len(own), _SAMPLES, 3).mean(axis=1)
    inside, way, share = faces.copy(), np.zeros((len(flat), 2)), np.zeros((len(flat), 3))
    inside[faces], way[faces], share[faces] = distance <= width, ways[nearest], near
    return Band(inside, way, share)
