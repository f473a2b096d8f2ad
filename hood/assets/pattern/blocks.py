"""Blocks of flat pattern making, drafted from the measures of a body: bodice, sleeve, skirt, trousers, bands and gathered rows.

Every panel is drawn counter-clockwise as it is seen from outside, so that all seams run against each other. Sides of a panel
have keys; in a panel that lies across the middle of the body they begin with the side of the body, ``left_`` or ``right_``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from hood.assets.pattern.measures import Measures
from hood.assets.pattern.pattern import Edge, PatternPanel, Stitch

XY = tuple[float, float]
Place = tuple[float, float, float]
#: A panel, and a side of it.
SideKey = tuple[str, str]
#: Panels begin so far [m] before and behind the trunk; those of a sleeve from the skin of the arm.
_APART, _FROM_ARM = 0.05, 0.035
#: Sleeves are longer than the arm by so much [m], which a raised arm takes.
_RAISED = 0.03
#: Degrees of the arms below the T-pose, for which sleeves are placed.
ARMS = 45.0
#: Labels of edges as GarmentCode has them, by the beginning of their keys; {} is the side of the body.
_LABELS = {"waist": "lower_interface", "top": "lower_interface", "neck": "{}_collar", "armhole": "{}_armhole"}


class Side(NamedTuple):
    """A side of a panel: its key, where it starts, and the control points of its Bézier curve."""

    key: str
    start: XY
    curve: tuple[XY, ...] = ()


Outline = Sequence[Side]


class Table:
    """The table on which panels are drawn, and what is sewn to what."""

    def __init__(self) -> None:
        self.panels: dict[str, PatternPanel] = {}
        self.stitches: list[Stitch] = []
        self.sides: dict[str, list[str]] = {}  # keys of the sides of a panel

    def draw(self, name: str, outline: Outline, angles: Place = (0, 0, 0), at: Place = (0, 0, 0), label: str = "body") -> None:
        edges = []
        for side, following in zip(outline, [*outline[1:], outline[0]], strict=True):
            curve = np.array(side.curve, dtype=np.float64).reshape(-1, 2)
            edges.append(Edge(np.array(side.start), np.array(following.start), curve, None, _label(side.key)))
        turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        self.panels[name] = PatternPanel(name, tuple(edges), tuple(range(len(edges))), turn, np.array(at, dtype=float), label)
        self.sides[name] = [side.key for side in outline]
        self._sew_darts(name)

    def _sew_darts(self, name: str) -> None:
        for key in self.sides[name]:
            if key.endswith("dart_a"):
                self.sew((name, key), (name, key.replace("dart_a", "dart_b")))

    def mirror(self, name: str, other: str) -> None:
        """Panel ``other``, the mirror image of a panel, with the same keys."""
        panel, flip, over = self.panels[name], np.array([-1.0, 1.0]), np.diag([-1.0, 1.0, 1.0])
        edges = [
            Edge(flip * edge.end, flip * edge.start, flip * edge.curve[::-1], None, _other(edge.label))
            for edge in reversed(panel.edges)
        ]
        placed = over @ panel.rotation @ over, over @ panel.translation
        self.panels[other] = PatternPanel(other, tuple(edges), panel.numbers, *placed, panel.label)
        self.sides[other] = self.sides[name][::-1]
        self._sew_darts(other)

    def keys(self, name: str, beginning: str) -> list[SideKey]:
        """The sides of a panel whose keys begin so, from the right of the body to its left for a panel in front, and from its
        left to its right for one behind: as the panel is seen."""
        panel, found = self.panels[name], [key for key in self.sides[name] if _bare(key).startswith(beginning)]
        middle = {key: float(panel.edges[self.sides[name].index(key)].at(np.array([0.5]))[0, 0]) for key in found}
        return [(name, key) for key in sorted(found, key=lambda key: middle[key])]

    def lengths(self, sides: Sequence[SideKey]) -> list[float]:
        return [self.panels[name].edges[self.sides[name].index(key)].length for name, key in sides]

    def sew(self, first: SideKey, second: SideKey, same: bool = False) -> None:
        ends = [(name, self.sides[name].index(key)) for name, key in (first, second)]
        self.stitches.append(Stitch(ends[0], ends[1], same))

    def sew_all(self, first: Sequence[SideKey], second: Sequence[SideKey]) -> None:
        for one, other in zip(first, second, strict=True):
            self.sew(one, other)

    def sew_keys(self, first: str, second: str, beginnings: Sequence[str]) -> None:
        """Two panels along every side whose keys begin so and are in both."""
        for key in self.sides[first]:
            if _bare(key).startswith(tuple(beginnings)) and key in self.sides[second]:
                self.sew((first, key), (second, key))


def _bare(key: str) -> str:
    return key.removeprefix("left_").removeprefix("right_")


def _other(word: str) -> str:
    """A word with its side changed."""
    return {"left": "right", "right": "left"}.get(word.split("_")[0], word.split("_")[0]) + word[len(word.split("_")[0]) :]


def _label(key: str) -> str:
    side = key.split("_")[0] if key != _bare(key) else "left"
    return next((label.format(side) for begin, label in _LABELS.items() if _bare(key).startswith(begin)), "")


def _flipped(points: Sequence[XY]) -> tuple[XY, ...]:
    return tuple((-x, y) for x, y in reversed(points))


def both_halves(half: Outline, end: XY, back: bool = False) -> list[Side]:
    """The outline of a panel across the middle, from that of its half at positive x: from the middle below to ``end``, the
    middle above. A panel behind the body is seen from there: its positive x is the right of the body."""
    near, far = ("right", "left") if back else ("left", "right")
    stops = [side.start for side in half[1:]] + [end]
    mine = [side._replace(key=f"{near}_{side.key}") for side in half]
    pairs = reversed(list(zip(half, stops, strict=True)))
    return mine + [Side(f"{far}_{side.key}", (-stop[0], stop[1]), _flipped(side.curve)) for side, stop in pairs]


def trunk_place(m: Measures, back: bool) -> tuple[Place, Place]:
    """Angles and translation of a panel before the trunk or behind it, whose y is the height above the floor."""
    if back:
        return (0.0, 180.0, 0.0), (0.0, 0.0, m.back - _APART)
    return (0.0, 0.0, 0.0), (0.0, 0.0, m.front + _APART)


def draw_strip(
    t: Table, name: str, above: Sequence[float], below: Sequence[float], height: float, bottom: float, at: tuple[Place, Place]
) -> None:
    """A strip of cloth, its upper and lower edge divided into pieces of those lengths [m], from left to right as it is seen."""
    x, wide = -0.5 * sum(below), 0.5 * sum(above)
    sides = []
    for number, length in enumerate(below):
        sides.append(Side(f"below{number}", (x, bottom)))
        x += length
    sides.append(Side("right_side" if at[0][1] else "left_side", (x, bottom)))
    x = wide
    for number in reversed(range(len(above))):
        sides.append(Side(f"{'top' if len(above) == 1 else 'above'}{number}", (x, bottom + height)))
        x -= above[number]
    sides.append(Side("left_side" if at[0][1] else "right_side", (-wide, bottom + height)))
    t.draw(name, sides, *at)


def band(t: Table, m: Measures, edges: Mapping[bool, Sequence[SideKey]], height: float, top: float) -> None:
    """A waistband of two strips over edges of the front (False) and of the back (True)."""
    for back, below in edges.items():
        name, lengths = f"band_{'back' if back else 'front'}", t.lengths(below)
        draw_strip(t, name, [sum(lengths)], lengths, height, top - height, trunk_place(m, back))
        t.sew_all(below, t.keys(name, "below"))
    t.sew_keys("band_front", "band_back", ["side"])


def tiers(
    t: Table, m: Measures, edges: Mapping[bool, Sequence[SideKey]], top: float, length: float, count: int, gathers: float
) -> None:
    """Rows of gathered cloth below edges of the front (False) and of the back (True)."""
    for number in range(1, count + 1):
        names = {}
        for back, above in edges.items():
            names[back] = name = f"tier{number}_{'back' if back else 'front'}"
            pieces = [gathers * part for part in t.lengths(above)]
            draw_strip(t, name, pieces, [sum(pieces)], length / count, top - number * length / count, trunk_place(m, back))
            t.sew_all(above, t.keys(name, "above") or t.keys(name, "top"))
        t.sew_keys(names[False], names[True], ["side"])
        edges = {back: t.keys(name, "below") for back, name in names.items()}


class Neck(NamedTuple):
    """A neckline and the shoulders: see designs.MEANINGS."""

    depth: float
    width: float = 0.0
    strap: float = 1.0
    shape: str = "round"


def upper_half(m: Measures, back: bool, ease: float, neck: Neck, below: XY | None = None) -> tuple[list[Side], XY]:
    """Armhole, shoulder and neckline of half a bodice, and where that ends; the side seam comes from ``below``."""
    over = m.back_length if back else float(np.clip(m.front_length, m.back_length - 0.01, m.back_length + 0.025))
    top, slope = m.waist_height + over, max(m.neck_height - m.shoulder_height, 0.01)
    inner, outer = np.array([m.neck_width, top]), np.array([0.5 * m.shoulder_width, top - slope])
    side, tip = inner + neck.width * (outer - inner), inner + neck.strap * (outer - inner)
    armpit = (0.25 * m.chest * (1.0 + ease), m.underarm_height - 0.02 - 0.1 * ease)
    across = min(tip[0], armpit[0]) - 0.02 * neck.strap
    lean = 0.0 if below is None else min((armpit[0] - below[0]) / (armpit[1] - below[1]), 0.5)
    armhole = ((across, armpit[1] + lean * (armpit[0] - across)), (across, 0.5 * (armpit[1] + tip[1])))
    depth = 0.02 + 0.05 * neck.width if back else neck.depth * over
    low = (0.0, float(min(top - depth, side[1] - 0.01)))
    round_ = ((0.6 if back else 0.9) * float(side[0]), low[1])
    curve = () if neck.shape == "v" and not back else (round_,)
    return [Side("armhole", armpit, armhole), Side("shoulder", _point(tip)), Side("neck", _point(side), curve)], low


def _fitted(below: XY, low: XY, high: XY, waist: XY, fit: float) -> tuple[XY, ...]:
    """Control points of a side seam that goes on from ``below`` and comes nearer to the waist where that is well between."""
    rise, share = high[1] - low[1], (waist[1] - low[1]) / (high[1] - low[1])
    if fit == 0.0 or not 0.25 < share < 0.75:
        return ()
    first = low[0] + (low[0] - below[0]) / max(low[1] - below[1], 1e-9) * rise / 3.0
    level = (1.0 - share) * low[0] + share * high[0]
    weights = [(1.0 - share) ** 3, 3.0 * (1.0 - share) ** 2 * share, 3.0 * (1.0 - share) * share**2, share**3]
    rest = weights[0] * low[0] + weights[1] * first + weights[3] * high[0]
    second = (level + fit * min(waist[0] - level, 0.0) - rest) / weights[2]
    return (first, low[1] + rise / 3.0), (second, low[1] + 2.0 * rise / 3.0)


def _onward(below: XY, low: XY, high: XY) -> tuple[XY, XY]:
    """Control points of a side that goes on from ``below`` at ``low``, but not outwards, and bends to a waist at ``high``."""
    rise, lean = high[1] - low[1], min((low[0] - below[0]) / (low[1] - below[1]), 0.0)
    return (low[0] + 0.35 * rise * lean, low[1] + 0.35 * rise), (high[0] + 0.3 * (low[0] - high[0]), high[1] - 0.35 * rise)


def _inward(low: XY, high: XY) -> tuple[XY, ...]:
    """Control points of a side that comes upright to ``high`` from ``low`` farther in; none from farther out."""
    third, rise = (high[0] - low[0]) / 3.0, high[1] - low[1]
    return ((low[0] + third, low[1] + rise / 3.0), (high[0], high[1] - 0.35 * rise)) if third > 0.0 else ()


def _dart(width: float) -> float:
    """Width [m] of a dart of about that width; none where it is too narrow."""
    return 0.0 if width < 0.01 else min(width, 0.035)


def _point(array: np.ndarray) -> XY:
    return float(array[0]), float(array[1])


def torso(t: Table, m: Measures, ease: float, length: float, neck: Neck, fit: float = 0.0, flare: float = 0.0) -> None:
    """Front and back from the shoulders to a hem below the waist, sewn at sides and shoulders."""
    hem = m.waist_height * (1.0 - length)
    wide = max(0.25 * m.chest * (1.0 + ease), 0.25 * m.hips * (1.0 + max(ease, 0.04)) if hem < m.waist_height - 0.08 else 0.0)
    for back in (False, True):
        armpit = upper_half(m, back, ease, neck)[0][0].start
        low, sides = (wide * (1.0 + flare), hem), []
        if hem < m.hip_height - 0.06:
            sides = [Side("side0", low)]
            low = (max(wide, low[0] + (armpit[0] - low[0]) * (m.hip_height - hem) / (armpit[1] - hem)), m.hip_height)
        curve = _fitted(sides[0].start if sides else low, low, armpit, (0.25 * m.waist * (1.0 + ease), m.waist_height), fit)
        upper, end = upper_half(m, back, ease, neck, curve[-1] if curve else low)
        half = [Side("hem", (0.0, hem)), *sides, Side("side1", low, curve), *upper]
        t.draw("back" if back else "front", both_halves(half, end, back), *trunk_place(m, back))
    t.sew_keys("front", "back", ["side", "shoulder"])


def bodice(t: Table, m: Measures, ease: float, neck: Neck) -> tuple[float, float]:
    """A bodice to the waist with a dart in each quarter; lengths [m] of the pieces of its waist from the middle on."""
    waist, chest = 0.25 * m.waist * (1.0 + max(ease, 0.04)), 0.25 * m.chest * (1.0 + ease)
    dart, inner = _dart(0.6 * (chest - waist)), 0.5 * waist
    for back in (False, True):
        upper, end = upper_half(m, back, ease, neck, (waist + dart, m.waist_height))
        low, apex = m.waist_height, m.waist_height + 0.7 * (upper[0].start[1] - m.waist_height)
        half = [
            Side("hem0", (0.0, low)),
            *([Side("dart_a", (inner, low)), Side("dart_b", (inner + 0.5 * dart, apex))] if dart else []),
            Side("hem1", (inner + dart, low)),
            Side("side", (waist + dart, low)),
            *upper,
        ]
        t.draw("back" if back else "front", both_halves(half, end, back), *trunk_place(m, back))
    t.sew_keys("front", "back", ["side", "shoulder"])
    return inner, waist - inner


def _cap(width: float, height: float) -> Edge:
    """Half of a sleeve's cap, from its top to the underarm."""
    curve = np.array([[0.45 * width, 0.0], [0.55 * width, -height]])
    return Edge(np.zeros(2), np.array([width, -height]), curve)


def _cap_size(front: float, back: float, width: float) -> tuple[float, float, float]:
    """Height and half widths [m] of a cap whose halves are so long, of a sleeve of that width where that can be."""

    def across(length: float, height: float) -> float:
        return float(brentq(lambda wide: _cap(wide, height).length - length, 1e-3, length))

    def more(height: float) -> float:
        return across(front, height) + across(back, height) - width

    # A higher cap hangs better and lifts the whole sleeve with a raised arm.
    low, high = 0.15 * min(front, back), 0.42 * min(front, back)
    height = low if more(low) <= 0.0 else high if more(high) >= 0.0 else float(brentq(more, low, high, xtol=1e-4))
    return height, across(front, height), across(back, height)


def sleeves(
    t: Table, m: Measures, ease: float, length: float, wide: float = 1.0, puff: float = 1.01, cuff: float = 0.0
) -> None:
    """Sleeves of two panels each, sewn into the armholes of front and back; cuffs of that height [m] at their ends."""
    armholes = t.lengths([("front", "left_armhole"), ("back", "left_armhole")])
    height, *halves = _cap_size(puff * armholes[0], puff * armholes[1], m.upper_arm * (1.15 + ease) * (0.5 + 0.5 * puff))
    length = max(length * (m.arm_length + _RAISED) - cuff, height + 0.04)
    # Along the arm the sleeve grows narrower as the arm does, to the hem that the option widens or narrows.
    arm = m.upper_arm + (m.wrist - m.upper_arm) * min(length / m.arm_length, 1.0)
    end = max(wide * sum(halves) * (0.35 + 0.65 * arm / m.upper_arm), arm * 1.1)
    hems = (0.5 * (end + halves[0] - halves[1]), 0.5 * (end - halves[0] + halves[1]))
    tip, off = (0.5 * m.shoulder_width, m.shoulder_height + 0.01), m.upper_arm / (2.0 * math.pi) + _FROM_ARM
    for back in (False, True):
        name, w, hem, at = (
            "back" if back else "front",
            halves[back],
            hems[back],
            (*tip, m.shoulder[2] + (-off if back else off)),
        )
        cap = tuple(_point(point) for point in _cap(w, height).curve)
        outline = [
            Side("end", (0.0, -length)),
            Side("under", (hem, -length)),
            Side("cap", (w, -height), cap[::-1]),
            Side("over", (0.0, 0.0)),
        ]
        if not back:
            outline = mirrored(outline)
        angles = (0.0, 180.0 if back else 0.0, 90.0 - ARMS)
        t.draw(f"left_sleeve_{name}", outline, angles, at, "arm")
        t.mirror(f"left_sleeve_{name}", f"right_sleeve_{name}")
        if cuff:
            band = 0.5 * arm * 1.45
            sides = [Side("rim", (0.0, -length - cuff)), Side("under", (band, -length - cuff)), Side("upper", (band, -length))]
            sides.append(Side("over", (0.0, -length)))
            t.draw(f"left_cuff_{name}", sides if back else mirrored(sides), angles, at, "arm")
            t.mirror(f"left_cuff_{name}", f"right_cuff_{name}")
    for side in ("left", "right"):
        for name in ("front", "back"):
            t.sew((f"{side}_sleeve_{name}", "cap"), (name, f"{side}_armhole"))
            if cuff:
                t.sew((f"{side}_sleeve_{name}", "end"), (f"{side}_cuff_{name}", "upper"))
        for part in ("sleeve", "cuff") if cuff else ("sleeve",):
            t.sew_keys(f"{side}_{part}_front", f"{side}_{part}_back", ["over", "under"])


def mirrored(outline: Outline) -> list[Side]:
    """The outline at the other side of x = 0, still counter-clockwise."""
    stops = [*[side.start for side in outline[1:]], outline[0].start]
    pairs = reversed(list(zip(outline, stops, strict=True)))
    return [Side(side.key, (-stop[0], stop[1]), _flipped(side.curve)) for side, stop in pairs]


def skirt(t: Table, m: Measures, ease: float, length: float, flare: float, pieces: tuple[float, float], top: float) -> None:
    """Front and back of a skirt with a dart in each quarter, from ``top`` [m]; pieces of its waist as of :func:`bodice`."""
    hem, hip = m.waist_height * (1.0 - length), 0.25 * m.hips * (1.0 + ease)
    inner, outer = pieces
    dart = _dart(0.45 * (hip - inner - outer)) if flare < 0.3 else 0.0
    side, low = inner + outer + dart, hip * (1.0 + flare)
    hip = max(hip, side + (low - side) * (top - m.hip_height) / (top - hem))
    apex = (inner + 0.5 * dart, top - 0.6 * (top - m.hip_height))
    corner = (low, hem + 0.15 * (low - hip))
    half = [
        Side("hem", (0.0, hem), ((0.6 * low, hem),)),
        Side("side0", corner, _inward(corner, (hip, m.hip_height))),
        Side("side1", (hip, m.hip_height), _onward(corner, (hip, m.hip_height), (side, top)) if flare < 0.3 else ()),
        Side("waist1", (side, top)),
        *([Side("dart_a", (inner + dart, top)), Side("dart_b", apex)] if dart else []),
        Side("waist0", (inner, top)),
    ]
    for back in (False, True):
        t.draw(f"skirt_{'back' if back else 'front'}", both_halves(half, (0.0, top), back), *trunk_place(m, back))
    t.sew_keys("skirt_front", "skirt_back", ["side"])


class Leg(NamedTuple):
    """Of trousers, see designs.MEANINGS; each quarter of their waist, at height ``top`` [m], has two ``pieces`` [m]."""

    ease: float
    knee: float
    hem: float
    length: float
    top: float
    pieces: tuple[float, float]


def legs(t: Table, m: Measures, leg: Leg) -> None:
    """Trousers of four panels with a dart each: the leg, its crotch curves, its waist in two pieces."""
    hip, crotch = 0.25 * m.hips * (1.0 + leg.ease), m.crotch_height - 0.01 - 0.03 * leg.ease
    low = crotch * (1.0 - leg.length)
    knee = 0.5 * m.knee * (1.0 + leg.knee)
    outer = 0.5 * (hip - 0.08 * m.hips) + 0.5 * knee  # x of the outer seam at the knee
    bends = low < m.knee_height - 0.08
    # Of shorts the hem lies between thigh and knee.
    share = min((crotch - low) / (crotch - m.knee_height), 1.0)
    wide = leg.hem * (knee if bends else (1.0 - share) * 0.5 * m.thigh * (1.0 + 0.5 * leg.ease + 0.08) + share * knee)
    hem_out = outer + 0.5 * (wide - knee) if bends else hip + (outer - hip) * share
    width, inseam = sum(leg.pieces), 0.0
    # The middle of the back is higher than the side, and both halves have their side in one place.
    side = (0.015 + math.sqrt((width + max(_dart(0.35 * (hip - width)), 0.01)) ** 2 - 0.02**2), leg.top)
    for back in (False, True):
        reach = m.hips * (0.105 if back else 0.055)
        middle, depth = (0.015, leg.top + 0.02) if back else (0.01, leg.top), leg.top - m.hip_height
        # The nearer the hem is to the crotch, the more the back is wider there, as it is above.
        more = 0.0 if bends else (1.0 - share) * (reach - 0.055 * m.hips)
        joint = (outer - knee, m.knee_height) if bends else (hem_out - wide - more, low)

        def inner(height: float, joint: XY = joint, reach: float = reach) -> Edge:
            bend = (joint[0] - 0.25 * (joint[0] + reach), joint[1] + 0.55 * (height - joint[1]))
            return Edge(np.array([-reach, height]), np.array(joint), np.array([bend]))

        fork = crotch
        if back:
            fork = float(brentq(lambda at, own=inseam: inner(at).length - own, joint[1] + 0.01, crotch + 0.06, xtol=1e-7))
        inseam = inner(fork).length
        low_end = Side("outer0", (hem_out, low)), Side("outer1", (outer, m.knee_height))
        sides = [Side("hem", (hem_out - wide - more, low)), *(low_end if bends else [Side("outer1", (hem_out, low))])]
        sides[-1] = sides[-1]._replace(curve=_inward(sides[-1].start, (hip, m.hip_height)))
        seat = fork + max(0.08, 1.1 * reach)
        sides += [
            Side("outer2", (hip, m.hip_height), _onward(sides[-1].start, (hip, m.hip_height), side)),
            *_slanted(middle, side, leg.pieces, depth),
            Side("centre", middle),
            Side("crotch", (0.0, seat), ((0.0, fork + 0.3 * (seat - fork)), (-0.35 * reach, fork))),
            Side("inner1", (-reach, fork), (_point(inner(fork).curve[0]),)),
        ]
        if bends:
            sides.append(Side("inner0", joint))
        own, name = ("right", "back") if back else ("left", "front")
        angles, at = trunk_place(m, back)
        aside = max(m.stance - outer + 0.5 * knee, 0.015)  # around the leg of a body that stands with its legs apart
        t.draw(f"{own}_leg_{name}", sides, angles, (-aside if back else aside, *at[1:]), "leg")
        t.mirror(f"{own}_leg_{name}", f"{_other(own)}_leg_{name}")
    for own in ("left", "right"):
        t.sew_keys(f"{own}_leg_front", f"{own}_leg_back", ["outer", "inner"])
    for name in ("front", "back"):
        t.sew_keys(f"left_leg_{name}", f"right_leg_{name}", ["centre", "crotch"])


def _slanted(middle: XY, corner: XY, pieces: tuple[float, float], depth: float) -> list[Side]:
    """The waist of a leg from its corner at the side to the middle: two pieces and a dart between them."""
    (inner, outer), side = pieces, np.array(corner)
    way = np.array(middle) - side
    dart = float(np.linalg.norm(way)) - inner - outer
    way /= inner + outer + dart
    first, apex = side + outer * way, side + (outer + 0.5 * dart) * way + 0.5 * max(depth, 0.06) * np.array([-way[1], way[0]])
    return [
        Side("waist1", _point(side)),
        Side("dart_a", _point(first)),
        Side("dart_b", _point(apex)),
        Side("waist0", _point(first + dart * way)),
    ]
