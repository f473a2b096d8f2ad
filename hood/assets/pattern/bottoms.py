"""Designs that hang from the waist: skirts, trousers and an apron."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.pattern.blocks import (
    XY,
    Leg,
    Side,
    SideKey,
    Table,
    band,
    both_halves,
    draw_strip,
    legs,
    skirt,
    tiers,
    trunk_place,
)
from hood.assets.pattern.making import Fold
from hood.assets.pattern.measures import Measures
from hood.assets.pattern.options import Choices, Design, Options, entered
from hood.assets.pattern.pattern import Edge, PatternPanel
from hood.assets.pattern.riding import Patch, button

#: Every design here by name.
BOTTOMS: dict[str, Design] = {}
#: The quarters of a skirt, and where they are around the body [degrees].
_AROUND = {"back_right": -135.0, "front_right": -45.0, "front_left": 45.0, "back_left": 135.0}
#: Pleats are folded by so much [rad] at rest, and stiffer there by this factor.
_LAID, _CREASE = math.radians(165.0), 5.0
#: Rows of stitches, and straps, are so wide [m]; of two panels in front the outer one begins so much farther out.
_STITCHES, _STRAP, _LAYER = 5e-3, 0.035, 0.03


def gores(t: Table, ring: float, circle: float, length: float, top: XY, least: float = 0.0) -> None:
    """Four sectors of a share of a circle, sewn to a ring around an edge of length ``ring`` [m] at ``top``, its y and z; each
    has two pieces there. They begin as a pyramid, tilted outwards by ``least`` [degrees] at least."""
    half, inner, off = 0.25 * math.pi * circle, ring / (2.0 * math.pi * circle), ring / (2.0 * math.pi) + 0.02
    tilt = math.degrees(math.asin(min(max(((inner + length) * math.sin(half) + 0.01 - off) / length, 0.0), 0.9)))

    def arc(radius: float, first: float, last: float) -> tuple[XY, tuple[XY, XY]]:
        """Start and control points of an arc below the centre, between two angles from straight down."""
        a, b, k = first, last, 4.0 / 3.0 * math.tan(0.25 * (last - first)) * radius
        start, end = (radius * math.sin(a), -radius * math.cos(a)), (radius * math.sin(b), -radius * math.cos(b))
        return start, (
            (start[0] + k * math.cos(a), start[1] + k * math.sin(a)),
            (end[0] - k * math.cos(b), end[1] - k * math.sin(b)),
        )

    low = inner + length
    outline = [
        Side("hem0", *arc(low, -half, 0.0)),
        Side("hem1", *arc(low, 0.0, half)),
        Side("ahead", arc(low, half, 0.0)[0]),
        Side("waist0", *arc(inner, half, 0.0)),
        Side("waist1", *arc(inner, 0.0, -half)),
        Side("behind", arc(inner, -half, 0.0)[0]),
    ]
    names = [f"gore_{name}" for name in _AROUND]
    for name, around in zip(names, _AROUND.values(), strict=True):
        angles = (-max(tilt, least), around, 0.0)
        out = np.array([math.sin(math.radians(around)), 0.0, math.cos(math.radians(around))])
        waist = Rotation.from_euler("xyz", angles, degrees=True).apply([0.0, -inner, 0.0])
        at = off * out + [0.0, *top] - waist
        t.draw(name, outline, angles, (float(at[0]), float(at[1]), float(at[2])))
    for name, other in zip(names, names[1:] + names[:1], strict=True):
        t.sew((name, "ahead"), (other, "behind"))


def gore_waist(t: Table, back: bool) -> list[SideKey]:
    """The waist of the gores in front or behind, as they are seen."""
    names = ("gore_back_left", "gore_back_right") if back else ("gore_front_right", "gore_front_left")
    return [side for name in names for side in t.keys(name, "waist")]


def leg_waist(t: Table, back: bool) -> list[SideKey]:
    """The waist of trousers in front or behind, as it is seen."""
    names = ("left_leg_back", "right_leg_back") if back else ("right_leg_front", "left_leg_front")
    return [side for name in names for side in t.keys(name, "waist")]


def _quarter(girth: float) -> tuple[float, float]:
    """A quarter of a waist of that girth [m] in two pieces; it is 2% wider than the body."""
    return 0.1275 * girth, 0.1275 * girth


def _skirt_with_band(t: Table, m: Measures, o: Options) -> None:
    skirt(t, m, o.ease, o.length, o.flare, _quarter(m.waist), m.waist_height)
    edges = {False: t.keys("skirt_front", "waist"), True: t.keys("skirt_back", "waist")}
    band(t, m, edges, o.band, m.waist_height + o.band)


_SKIRT: dict[str, Choices] = {"ease": (0.05, 0.02, 0.3), "length": (0.5, 0.3, 0.95), "band": (0.035, 0.03, 0.08)}


@entered(BOTTOMS, **_SKIRT, flare=(0.3, 0.0, 1.2))
def _skirt(t: Table, m: Measures, o: Options) -> None:
    _skirt_with_band(t, m, o)


@entered(BOTTOMS, **_SKIRT, flare=(-0.06, -0.12, 0.0))
def _pencil(t: Table, m: Measures, o: Options) -> None:
    _skirt_with_band(t, m, o)


@entered(BOTTOMS, length=(0.5, 0.2, 0.95), circle=(1.0, 0.3, 1.2), band=(0.035, 0.03, 0.08))
def _circle(t: Table, m: Measures, o: Options) -> None:
    middle = 0.5 * (m.front + m.back)
    gores(t, 1.02 * m.waist, o.circle, o.length * m.waist_height, (m.waist_height, middle))
    band(t, m, {back: gore_waist(t, back) for back in (False, True)}, o.band, m.waist_height + o.band)


def _rows(t: Table, m: Measures, length: float, count: int, gathers: float, height: float) -> None:
    """A waistband of two strips, and gathered rows below it."""
    edges, half = {}, 0.51 * m.waist
    for back in (False, True):
        name = f"band_{'back' if back else 'front'}"
        draw_strip(t, name, [half], [half], height, m.waist_height, trunk_place(m, back))
        edges[back] = t.keys(name, "below")
    t.sew_keys("band_front", "band_back", ["side"])
    tiers(t, m, edges, m.waist_height, length * m.waist_height, count, gathers)


@entered(BOTTOMS, length=(0.5, 0.2, 0.95), gathers=(1.7, 1.35, 2.5), band=(0.035, 0.03, 0.08))
def _gathered(t: Table, m: Measures, o: Options) -> None:
    _rows(t, m, o.length, 1, o.gathers, o.band)


@entered(BOTTOMS, length=(0.6, 0.3, 0.95), gathers=(1.4, 1.35, 1.7), tiers=(3.0, 2.0, 4.0), band=(0.035, 0.03, 0.08))
def _tiered(t: Table, m: Measures, o: Options) -> None:
    _rows(t, m, o.length, round(o.tiers), o.gathers, o.band)


def _pleated_outline(m: Measures, o: Options) -> tuple[list[Side], tuple[Fold, ...], float]:
    """A quarter of a pleated skirt, a sector below (0, 0) whose folds run from the waist to the hem; half its width at the hem
    with the pleats laid [m].

    Every pleat hides a flap. The upper edges of a flap are sewn to each other; the visible pieces between are the waist.
    """
    long, count, box = o.length * m.waist_height, round(0.25 * o.pleats), o.pleat == "box"
    waist = 1.02 * m.waist * 0.25 / count
    # What is seen grows evenly from the waist to the hem, over the hips.
    hem = waist + ((1.0 + o.ease) * m.hips * 0.25 / count - waist) * long / (m.waist_height - m.hip_height)
    # Mountains are beyond 0. The seams are at the edges of flaps of knife pleats, and in the middle of those of box pleats.
    unit = {"waist": _LAID, "1dart_a": -_LAID, "1dart_b": 0.0}
    unit = {"2dart_a": -_LAID, "2dart_b": _LAID, **unit} if box else unit
    keys = [key for _ in range(count) for key in unit]
    deep = o.under * waist * (0.5 if box else 1.0)
    steps = [np.cumsum([0.0, *(wide if key == "waist" else deep for key in keys)]) for wide in (waist, hem)]
    turn = max((steps[1][-1] - steps[0][-1]) / long, 0.01)
    inner = float(steps[0][-1]) / turn
    # Where the fold of a flap begins, its edge is cut deeper, as a dart is.
    notches = np.array([deep if key.endswith("dart_b") else 0.0 for key in [*keys, ""]])
    angles = [turn * (way / way[-1] - 0.5) for way in steps]
    above, below = (
        list(zip((radius * np.sin(angle)).tolist(), (inner - radius * np.cos(angle)).tolist(), strict=True))
        for radius, angle in zip((inner + notches, np.full(len(notches), inner + long)), angles, strict=True)
    )
    names = [f"waist{k}" if key == "waist" else f"{k // len(unit)}_{key}" for k, key in enumerate(keys)]
    sides = [*(Side(f"hem{k}", point) for k, point in enumerate(below[:-1])), Side("ahead", below[-1])]
    sides += [Side(key, point) for key, point in zip(names[::-1], above[:0:-1], strict=True)]
    lines = zip(above[1:-1], below[1:-1], list(unit.values()) * count, strict=False)
    folds = tuple(Fold(np.array(start), np.array(end), angle, _CREASE) for start, end, angle in lines if angle)
    return [*sides, Side("behind", above[0])], folds, 0.5 * hem * count


@entered(
    BOTTOMS,
    ease=(0.05, 0.02, 0.3),
    length=(0.45, 0.25, 0.8),
    pleats=(16.0, 8.0, 24.0),
    pleat=("knife", "box"),
    under=(0.8, 0.7, 0.95),
    band=(0.035, 0.03, 0.08),
)
def _pleated(t: Table, m: Measures, o: Options) -> None:
    outline, folds, half = _pleated_outline(m, o)
    off, middle = 1.02 * m.waist / (2.0 * math.pi) + 0.02, 0.5 * (m.front + m.back)
    tilt = math.degrees(math.asin(min(max((half + 0.01 - off) / (o.length * m.waist_height), 0.0), 0.9)))
    for name, around in _AROUND.items():
        x, z = math.sin(math.radians(around)), math.cos(math.radians(around))
        t.draw(f"skirt_{name}", outline, (-tilt, around, 0.0), (off * x, m.waist_height, middle + off * z))
        t.panels[f"skirt_{name}"] = replace(t.panels[f"skirt_{name}"], folds=folds)
    names = [f"skirt_{name}" for name in _AROUND]
    for name, other in zip(names, names[1:] + names[:1], strict=True):
        t.sew((name, "ahead"), (other, "behind"))
    halves = {False: names[1:3], True: [names[3], names[0]]}
    edges = {back: [side for name in own for side in t.keys(name, "waist")] for back, own in halves.items()}
    band(t, m, edges, o.band, m.waist_height + o.band)


@entered(
    BOTTOMS,
    ease=(0.05, 0.02, 0.3),
    length=(0.5, 0.3, 0.95),
    flare=(0.35, 0.3, 1.0),
    overlap=(0.6, 0.2, 0.85),
    band=(0.035, 0.03, 0.08),
)
def _wrap(t: Table, m: Measures, o: Options) -> None:
    """The two fronts meet in one point of the waist and overlap below it: both in one seam of the band are three layers."""
    plain, top = Table(), m.waist_height
    skirt(plain, m, o.ease, o.length, o.flare, _quarter(m.waist), top)
    names = ["hem", "side0", "side1", "waist1", "waist0"]
    front = _keyed(plain.panels["skirt_front"], [f"left_{name}" for name in names] + [f"right_{name}" for name in names[::-1]])
    back = _keyed(plain.panels["skirt_back"], [f"right_{name}" for name in names] + [f"left_{name}" for name in names[::-1]])
    half, (_, low) = front["left_side0"].start[0], front["left_hem"].start
    angles, (_, _, z) = trunk_place(m, False)

    def corner(x: float) -> XY:
        """The lower end of a free edge, which is as long as the middle is."""
        return x, top - math.sqrt((top - low) ** 2 - (x - front["left_waist0"].start[0]) ** 2)

    outer, inner = corner(o.overlap * half), corner(-0.5 * o.overlap * half)
    over = [front["right_hem"], Side("over_hem", (0.0, low), ((0.5 * outer[0], low),)), Side("edge", outer)]
    over += [front["left_waist0"], *(front[f"right_{name}"] for name in names[:0:-1])]
    under = [Side("under_hem", inner, ((0.5 * inner[0], low),)), *(front[f"left_{name}"] for name in names[:-1])]
    t.draw("skirt_front_over", over, angles, (0.0, 0.0, z + _LAYER))
    t.draw("skirt_front_under", [*under, Side("edge", front["left_waist0"].start)], angles, (0.0, 0.0, z))
    t.draw("skirt_back", list(back.values()), *trunk_place(m, True))
    for name in ("skirt_front_over", "skirt_front_under"):
        t.sew_keys(name, "skirt_back", ["side"])
    edges = [*t.keys("skirt_front_over", "waist"), *t.keys("skirt_front_under", "waist")]
    band(t, m, {False: edges, True: t.keys("skirt_back", "waist")}, o.band, top + o.band)


def _keyed(panel: PatternPanel, keys: Sequence[str]) -> dict[str, Side]:
    """The sides of a panel by keys that are given in their order."""
    return {
        key: Side(key, (float(edge.start[0]), float(edge.start[1])), tuple((float(x), float(y)) for x, y in edge.curve))
        for key, edge in zip(keys, panel.edges, strict=True)
    }


@entered(
    BOTTOMS,
    length=(0.4, 0.2, 0.8),
    flare=(0.15, 0.0, 0.6),
    bib=(0.6, 0.45, 0.75),
    straps=("neck", "back"),
    band=(0.04, 0.03, 0.08),
)
def _apron(t: Table, m: Measures, o: Options) -> None:
    """Open behind, below a waistband that is closed there as its tie is."""
    low, size, behind = m.waist_height, m.height / 1.72, o.straps == "back"
    waist, high = low + o.band, low + float(np.clip(m.front_length, m.back_length - 0.01, m.back_length + 0.025))
    wide, half, hem = 0.3 * m.waist, 0.13 * size, low * (1.0 - o.length)
    # Where the straps cross the shoulder, and the upper edge of the bib.
    inner, outer = np.array([m.neck_width, high]), np.array([0.5 * m.shoulder_width, high - m.neck_height + m.shoulder_height])
    first = 0.25 if behind else 0.05
    shares = first, first + _STRAP / float(np.linalg.norm(outer - inner))
    near, far = ((float(x), float(y)) for x, y in (inner + share * (outer - inner) for share in shares))
    top, corner = waist + o.bib * (high - waist), max(0.1 * size, far[0])
    bib = [
        Side("bottom", (0.0, waist)),
        Side("open", (half, waist), ((half, waist + 0.5 * (top - waist)),)),
        Side("strap_out", (corner, top)),
        Side("shoulder", far),
        Side("strap_in", near),
        Side("upper", (corner - _STRAP, top)),
    ]
    t.draw("bib_front", both_halves(bib, (0.0, top)), *trunk_place(m, False))
    skirt_half = [Side("hem", (0.0, hem)), Side("open", (0.3 * m.hips * (1.0 + o.flare), hem)), Side("waist", (wide, low))]
    t.draw("skirt_front", both_halves(skirt_half, (0.0, low)), *trunk_place(m, False))
    draw_strip(t, "tie_front", [wide - half, half, half, wide - half], [wide, wide], o.band, low, trunk_place(m, False))
    rest = 0.2 * m.waist
    place, gap = trunk_place(m, True), 0.045 * size
    pieces = [rest - gap - _STRAP, _STRAP, 2.0 * gap, _STRAP, rest - gap - _STRAP] if behind else [2.0 * rest]
    draw_strip(t, "tie_back", pieces, [2.0 * rest], o.band, low, place)
    t.sew_keys("tie_front", "tie_back", ["side"])
    t.sew_all(t.keys("skirt_front", "waist"), t.keys("tie_front", "below"))
    t.sew_all(t.keys("bib_front", "bottom"), t.keys("tie_front", "above")[1:3])
    if behind:
        strap = [Side("bottom", (gap, waist)), Side("out", (gap + _STRAP, waist)), Side("shoulder", far), Side("in", near)]
        t.draw("right_strap_back", strap, *place)
        t.mirror("right_strap_back", "left_strap_back")
        for side, piece in (("left", 1), ("right", 3)):
            t.sew((f"{side}_strap_back", "bottom"), t.keys("tie_back", "above")[piece])
            t.sew((f"{side}_strap_back", "shoulder"), ("bib_front", f"{side}_shoulder"))
    else:
        deep = high - 0.03
        loop = [
            Side("out", (0.0, deep - _STRAP), ((0.9 * far[0], deep - _STRAP),)),
            Side("shoulder", far),
            Side("in", near, ((0.9 * near[0], deep),)),
        ]
        t.draw("strap_back", both_halves(loop, (0.0, deep), True), *place)
        t.sew_keys("strap_back", "bib_front", ["shoulder"])
    x, y, tall = 0.11 * size, low - 0.07 * size, 0.15 * size
    pocket = Patch("pocket", np.array([(-x, y - tall), (x, y - tall), (x, y), (-x, y)]))
    t.panels["skirt_front"] = replace(t.panels["skirt_front"], patches=(pocket,))


def _trousers_with_band(t: Table, m: Measures, o: Options, knee: float, hem: float) -> None:
    top = m.waist_height + o.rise - o.band
    waist = float(np.interp(top, [m.hip_height, m.waist_height], [m.hips, m.waist]))
    legs(t, m, Leg(o.ease, knee, hem, o.length, top, _quarter(waist)))
    band(t, m, {back: leg_waist(t, back) for back in (False, True)}, o.band, top + o.band)


_LEGS: dict[str, Choices] = {"rise": (-0.03, -0.07, 0.0), "band": (0.035, 0.03, 0.05)}


@entered(BOTTOMS, **_LEGS, ease=(0.06, 0.02, 0.3), length=(0.93, 0.65, 0.97), knee=(0.3, 0.1, 1.0), hem=(0.95, 0.7, 1.8))
def _trousers(t: Table, m: Measures, o: Options) -> None:
    _trousers_with_band(t, m, o, o.knee, o.hem)


@entered(BOTTOMS, **_LEGS, ease=(0.01, -0.03, 0.06), length=(0.85, 0.5, 0.88), knee=(0.05, 0.0, 0.15), hem=(1.1, 1.0, 1.3))
def _leggings(t: Table, m: Measures, o: Options) -> None:
    _trousers_with_band(t, m, o, o.knee, o.hem * m.ankle / m.knee)


@entered(BOTTOMS, **_LEGS, ease=(0.08, 0.03, 0.3), length=(0.3, 0.12, 0.55), hem=(1.1, 1.0, 1.5))
def _shorts(t: Table, m: Measures, o: Options) -> None:
    _trousers_with_band(t, m, o, 0.4, o.hem)


def _across(panel: PatternPanel, height: float) -> tuple[float, float]:
    """The least and the greatest x of a panel at a height [m]."""
    line = np.concatenate([edge.evenly(64) for edge in panel.edges])
    start, end = line[:-1], line[1:]
    cut = (start[:, 1] > height) != (end[:, 1] > height)
    share = (height - start[cut, 1]) / (end[cut, 1] - start[cut, 1])
    x = start[cut, 0] + share * (end[cut, 0] - start[cut, 0])
    return float(x.min()), float(x.max())


def _strip(name: str, line: Sequence[XY]) -> Patch:
    """A row of stitches along a line: a narrow patch to its left."""
    points = np.array(line)
    way = np.gradient(points, axis=0)
    left = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.linalg.norm(way, axis=1, keepdims=True)
    return Patch(name, np.concatenate([points, (points + _STITCHES * left)[::-1]]))


def _bow(start: XY, middle: XY, end: XY) -> list[XY]:
    """Points of a curve from one point towards another to a third."""
    points = Edge(np.array(start), np.array(end), np.array([middle])).evenly(16)
    return [(float(x), float(y)) for x, y in points]


def _turn_up(panel: PatternPanel, low: float, height: float) -> list[Patch]:
    """The hem of a leg, turned up."""
    if height < 0.02:
        return []
    rows = [(*_across(panel, low + share * height), low + share * height) for share in (0.02, 0.5, 1.0)]
    inset = 2e-3
    right, left = [(x - inset, y) for _, x, y in rows], [(x + inset, y) for x, _, y in rows]
    return [Patch("turn_up", np.array([*right, *left[::-1]]))]


def _jeans_front(panel: PatternPanel, top: float, size: float, coin: bool) -> list[Patch]:
    """The line of the front pocket, with a coin pocket below it on one side."""
    deep, wide = 0.15 * size, 0.1 * size
    side, corner = _across(panel, top - deep)[1], _across(panel, top - 0.004)[1]
    line = _bow((corner - wide, top - 0.004), (corner - 0.85 * wide, top - 0.8 * deep), (side - 0.002, top - deep))
    found = [_strip("pocket_line", line)]
    if coin:
        x, y, half, tall = corner - 0.05 * size, top - 0.03 * size, 0.026 * size, 0.06 * size
        found.append(Patch("coin_pocket", np.array([(x - half, y - tall), (x + half, y - tall), (x + half, y), (x - half, y)])))
    return found


def _jeans_back(panel: PatternPanel, top: float, size: float) -> list[Patch]:
    """The line of the yoke and a pocket below it."""
    inner, outer = top - 0.075 * size, top - 0.04 * size
    ends = (_across(panel, inner)[0] + 0.003, inner), (_across(panel, outer)[1] - 0.003, outer)
    middle = 0.5 * (ends[0][0] + ends[1][0])
    pocket = np.array([(-0.058, -0.11), (0.0, -0.145), (0.058, -0.11), (0.066, 0.005), (-0.066, -0.01)]) * size
    return [_strip("yoke", ends), Patch("pocket", pocket + [middle, 0.5 * (inner + outer) - 0.04 * size])]


@entered(
    BOTTOMS,
    **_LEGS,
    ease=(0.05, 0.02, 0.2),
    length=(0.95, 0.65, 0.97),
    knee=(0.2, 0.08, 0.6),
    hem=(0.85, 0.7, 1.6),
    turn=(0.03, 0.0, 0.08),
)
def _jeans(t: Table, m: Measures, o: Options) -> None:
    _trousers_with_band(t, m, o, o.knee, o.hem)
    top, size = m.waist_height + o.rise - o.band, m.height / 1.72
    low = (m.crotch_height - 0.01 - 0.03 * o.ease) * (1.0 - o.length)
    fly = [*_bow((0.012, top - 0.15 * size), (0.045, top - 0.145 * size), (0.045, top - 0.09 * size)), (0.045, top - 0.004)]
    fronts, backs = t.panels["left_leg_front"], t.panels["right_leg_back"]
    own = {
        "left_leg_front": [*_jeans_front(fronts, top, size, False), _strip("fly", fly)],
        "right_leg_front": [patch.mirrored() for patch in _jeans_front(fronts, top, size, True)],
        "right_leg_back": _jeans_back(backs, top, size),
        "left_leg_back": [patch.mirrored() for patch in _jeans_back(backs, top, size)],
    }
    for name, panel in (("left_leg_front", fronts), ("right_leg_back", backs)):
        turned, other = _turn_up(panel, low, o.turn), {"left": "right", "right": "left"}[name.split("_")[0]]
        own[name] += turned
        own[f"{other}_{name.split('_', 1)[1]}"] += [patch.mirrored() for patch in turned]
    for back in (False, True):
        name = f"band_{'back' if back else 'front'}"
        half = 0.25 * float(sum(edge.length for edge in t.panels[name].edges if edge.label == "lower_interface"))
        loops = [-1.6 * half, -0.55 * half, *([0.0] if back else []), 0.55 * half, 1.6 * half]
        own[name] = [_loop(x, top, o.band) for x in loops]
    own["band_front"].append(button(0.0, top + 0.5 * o.band))
    for name, patches in own.items():
        t.panels[name] = replace(t.panels[name], patches=tuple(patches))


def _loop(x: float, low: float, tall: float) -> Patch:
    """A loop for a belt, on a waistband from ``low`` [m] up."""
    return Patch(
        "loop",
        np.array(
            [(x - 0.005, low + 1e-3), (x + 0.005, low + 1e-3), (x + 0.005, low + tall - 1e-3), (x - 0.005, low + tall - 1e-3)]
        ),
    )
