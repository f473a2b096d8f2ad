"""Own sewing patterns by name, made to measure: each is drawn from the blocks with its options; CC0."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.library import nearest, unknown
from hood.assets.pattern.blocks import (
    XY,
    Leg,
    Neck,
    Side,
    SideKey,
    Table,
    band,
    bodice,
    both_halves,
    draw_strip,
    legs,
    skirt,
    sleeves,
    tiers,
    torso,
    trunk_place,
    upper_half,
)
from hood.assets.pattern.measures import Measures
from hood.assets.pattern.pattern import MOST_GATHERED, Pattern, check_pattern

#: What an option means, by its name.
MEANINGS = {
    "ease": "what the garment is wider than chest and hips, as a share of them",
    "length": "from the waist to the hem, as a share of the waist's height; of trousers, a share of the inside leg",
    "sleeve": "length of the sleeves, as a share of the arm; below 0.1 there are none",
    "cuff": "height of the cuffs [m]; below 0.02 there are none",
    "wide": "hem of the sleeves, as a share of their usual width there",
    "puff": "length of the sleeve's cap over that of the armhole; above 1.05 it is gathered",
    "depth": "of the neckline in front, as a share of the way to the waist",
    "width": "of the neckline, as a share of the shoulder that it leaves free",
    "strap": "where the shoulder ends, as a share of its length",
    "shape": "of the neckline",
    "collar": "of the neckline",
    "fit": "1: the side seams follow the waist; 0: they are straight",
    "flare": "what the hem is wider than the hips, as a share",
    "gathers": "length of a gathered edge over that of the one which it is sewn to",
    "tiers": "number of gathered rows",
    "circle": "share of a circle that the skirt is cut from",
    "band": "height of the waistband [m]",
    "rise": "of the upper edge over the waist [m]",
    "knee": "what the leg is wider than the knee, as a share",
    "hem": "width of the leg at its hem, as a share of that above it",
}
Choices = tuple[float, float, float] | tuple[str, ...]
#: Chosen options: numbers and words by their names.
Options = SimpleNamespace


@dataclass(frozen=True)
class Design:
    """A design: how it is drawn, and its options: (default, least, most) of numbers, else words of which the first is taken."""

    draw: Callable[[Table, Measures, Options], None]
    options: Mapping[str, Choices]


#: Every design by name.
DESIGNS: dict[str, Design] = {}


def draft(name: str, measures: Measures, options: Mapping[str, Any] | None = None) -> Pattern:
    """A design for a body of those measures.

    Args:
        options: those that are not at their defaults, see ``DESIGNS[name].options``.

    Raises:
        ValueError: an unknown design or option, or a value out of its range; the sentence names what there is.

    Examples:
        >>> import hood
        >>> from hood.assets.pattern.designs import draft
        >>> from hood.assets.pattern.measures import measure_body
        >>> body = hood.load_body()
        >>> vertices, joints = body.shaped([0.0])
        >>> pattern = draft("skirt", measure_body(vertices, body.faces, joints), {"flare": 0.5})
        >>> sorted(pattern.panels)
        ['band_back', 'band_front', 'skirt_back', 'skirt_front']
    """
    if name not in DESIGNS:
        raise ValueError(unknown("design", name, DESIGNS))
    design = DESIGNS[name]
    chosen: dict[str, float | str] = {key: own[0] for key, own in design.options.items()}
    for key, value in (options or {}).items():
        if key not in chosen:
            meant = nearest(key, chosen)
            known = [ranged(name, one) for one in chosen]
            raise ValueError(f"design:{name}: {unknown('option', key, known, meant and ranged(name, meant))}")
        chosen[key] = _checked(name, key, value)
    table = Table()
    design.draw(table, measures, Options(**chosen))
    pattern = Pattern(name, table.panels, tuple(table.stitches), measures.height)
    check_pattern(f"design:{name}", pattern, MOST_GATHERED)
    return pattern


def ranged(name: str, key: str) -> str:
    """An option of a design with what it may be."""
    known = DESIGNS[name].options[key]
    return (
        f"{key} ({known[1]:g} to {known[2]:g})"
        if len(known) == 3 and not isinstance(known[0], str)
        else (f"{key} ({', '.join(map(str, known))})")
    )


def _checked(name: str, key: str, value: Any) -> float | str:
    known = DESIGNS[name].options[key]
    if isinstance(known[0], str):
        if value not in known:
            raise ValueError(f"design:{name}: {key} is {value!r}; give one of {', '.join(map(str, known))}")
        return str(value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not known[1] <= value <= known[2]:  # type: ignore[operator]
        raise ValueError(f"design:{name}: {key} is {value!r}; give a number from {known[1]:g} to {known[2]:g}: {MEANINGS[key]}")
    return float(value)


def _design(**options: Choices) -> Callable[[Callable[[Table, Measures, Options], None]], None]:
    """Enter a function as the design of its name."""

    def enter(draw: Callable[[Table, Measures, Options], None]) -> None:
        DESIGNS[draw.__name__.removeprefix("_")] = Design(draw, options)

    return enter


def _gores(t: Table, ring: float, circle: float, length: float, top: XY, least: float = 0.0) -> None:
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
    names = ["gore_back_right", "gore_front_right", "gore_front_left", "gore_back_left"]
    for name, around in zip(names, (-135.0, -45.0, 45.0, 135.0), strict=True):
        angles = (-max(tilt, least), around, 0.0)
        out = np.array([math.sin(math.radians(around)), 0.0, math.cos(math.radians(around))])
        waist = Rotation.from_euler("xyz", angles, degrees=True).apply([0.0, -inner, 0.0])
        at = off * out + [0.0, *top] - waist
        t.draw(name, outline, angles, (float(at[0]), float(at[1]), float(at[2])))
    for name, other in zip(names, names[1:] + names[:1], strict=True):
        t.sew((name, "ahead"), (other, "behind"))


def _gore_waist(t: Table, back: bool) -> list[SideKey]:
    """The waist of the gores in front or behind, as they are seen."""
    names = ("gore_back_left", "gore_back_right") if back else ("gore_front_right", "gore_front_left")
    return [side for name in names for side in t.keys(name, "waist")]


def _leg_waist(t: Table, back: bool) -> list[SideKey]:
    """The waist of trousers in front or behind, as it is seen."""
    names = ("left_leg_back", "right_leg_back") if back else ("right_leg_front", "left_leg_front")
    return [side for name in names for side in t.keys(name, "waist")]


def _neck(o: Options, strap: float = 1.0, width: float | None = None) -> Neck:
    return Neck(o.depth, o.width if width is None else width, strap, o.shape)


def _sleeved(t: Table, m: Measures, o: Options, puff: float = 1.01) -> None:
    if o.sleeve >= 0.1:
        sleeves(t, m, o.ease, o.sleeve, o.wide, puff)


@_design(
    ease=(0.08, 0.02, 0.4),
    length=(0.2, 0.05, 0.5),
    depth=(0.32, 0.15, 0.5),
    width=(0.35, 0.1, 0.45),
    strap=(0.75, 0.7, 0.95),
    shape=("round", "v"),
    fit=(0.3, 0.0, 1.0),
)
def _tank(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, _neck(o, o.strap), o.fit)


@_design(
    ease=(0.1, 0.03, 0.5),
    length=(0.22, 0.05, 0.5),
    sleeve=(0.35, 0.15, 1.0),
    wide=(1.0, 0.7, 2.0),
    depth=(0.2, 0.12, 0.45),
    width=(0.12, 0.0, 0.5),
    shape=("round", "v"),
    fit=(0.0, 0.0, 1.0),
)
def _tshirt(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, _neck(o), o.fit)
    _sleeved(t, m, o)


def _collar(t: Table, m: Measures, height: float) -> None:
    """A stand of two strips on the neckline."""
    for back in (False, True):
        name = "back" if back else "front"
        below = t.keys(name, "neck")
        lengths = t.lengths(below)
        angles, at = trunk_place(m, back)
        shift = (at[0], at[1], m.shoulder[2] + (-0.1 if back else 0.1))
        draw_strip(t, f"collar_{name}", lengths, lengths, height, m.neck_height, (angles, shift))
        t.sew_all(below, t.keys(f"collar_{name}", "below"))
    t.sew_keys("collar_front", "collar_back", ["side"])


@_design(
    ease=(0.14, 0.05, 0.5),
    length=(0.26, 0.1, 0.6),
    sleeve=(0.95, 0.4, 1.0),
    wide=(1.1, 0.8, 1.6),
    cuff=(0.05, 0.0, 0.1),
    collar=("stand", "none"),
    depth=(0.2, 0.12, 0.3),
    fit=(0.3, 0.0, 1.0),
)
def _shirt(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, Neck(o.depth, 0.04), o.fit)
    sleeves(t, m, o.ease, o.sleeve, o.wide, 1.01, o.cuff if o.cuff >= 0.02 else 0.0)
    if o.collar == "stand":
        _collar(t, m, 0.035)


@_design(
    ease=(0.2, 0.08, 0.5),
    length=(0.22, 0.1, 0.5),
    sleeve=(0.97, 0.4, 1.0),
    wide=(1.15, 0.9, 1.6),
    cuff=(0.06, 0.0, 0.1),
    depth=(0.2, 0.14, 0.3),
    width=(0.1, 0.0, 0.3),
)
def _hoodie(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, Neck(o.depth, o.width))
    sleeves(t, m, o.ease, o.sleeve, o.wide, 1.01, o.cuff if o.cuff >= 0.02 else 0.0)
    _hood(t, m)


def _hood(t: Table, m: Measures) -> None:
    """A hood of two halves on the neckline, which meet in the middle of the front."""
    front, back = t.lengths([("front", "left_neck"), ("back", "left_neck")])
    tall, end = m.height - m.neck_height + 0.06, front + back
    deep = max(end, 0.42 * m.head)
    half = [
        Side("neck_front", (0.0, 0.0)),
        Side("neck_back", (front, 0.0)),
        Side("seam", (end, 0.0), ((deep + 0.06, 0.5 * tall), (deep + 0.02, 1.02 * tall))),
        Side("rim", (0.0, tall)),
    ]
    around = 75.0
    # The end of the shoulder seam is at the side of the neck; the halves open a little to the front.
    x, z = math.cos(math.radians(around)), math.sin(math.radians(around))
    at = (0.11 - x * front, m.neck_height + 0.02, m.shoulder[2] + 0.02 + z * front)
    t.draw("left_hood", half, (0.0, around, 0.0), at)
    t.mirror("left_hood", "right_hood")
    for side in ("left", "right"):
        for name in ("front", "back"):
            t.sew((f"{side}_hood", f"neck_{name}"), (name, f"{side}_neck"))
    t.sew(("left_hood", "seam"), ("right_hood", "seam"))


_BODICE: dict[str, Choices] = {
    "ease": (0.08, 0.04, 0.3),
    "sleeve": (0.0, 0.0, 1.0),
    "wide": (1.0, 0.7, 2.0),
    "puff": (1.01, 1.0, 1.5),
    "depth": (0.25, 0.12, 0.45),
    "width": (0.2, 0.0, 0.5),
    "shape": ("round", "v"),
}


_STRAIGHT = {key: own for key, own in _BODICE.items() if key != "puff"}


@_design(**_BODICE)
def _bodice(t: Table, m: Measures, o: Options) -> None:
    bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)


@_design(**_BODICE, length=(0.5, 0.3, 0.95), flare=(0.0, -0.06, 0.8))
def _sheath(t: Table, m: Measures, o: Options) -> None:
    pieces = bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)
    skirt(t, m, o.ease, o.length, o.flare, pieces, m.waist_height)
    for name in ("front", "back"):
        t.sew_all(t.keys(name, "hem"), t.keys(f"skirt_{name}", "waist"))


@_design(**_BODICE, length=(0.5, 0.2, 0.95), gathers=(1.6, 1.1, 2.5), tiers=(1.0, 1.0, 4.0))
def _dress(t: Table, m: Measures, o: Options) -> None:
    bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)
    edges = {back: t.keys("back" if back else "front", "hem") for back in (False, True)}
    count = round(o.tiers)
    tiers(t, m, edges, m.waist_height, o.length * m.waist_height, count, o.gathers if count == 1 else min(o.gathers, 1.7))


@_design(**_BODICE, length=(0.5, 0.2, 0.95), circle=(0.75, 0.4, 1.2))
def _swing(t: Table, m: Measures, o: Options) -> None:
    ring = 4.0 * sum(bodice(t, m, o.ease, _neck(o)))
    _sleeved(t, m, o, o.puff)
    _gores(t, ring, o.circle, o.length * m.waist_height, (m.waist_height, 0.5 * (m.front + m.back)))
    for back, name in enumerate(("front", "back")):
        t.sew_all(t.keys(name, "hem"), _gore_waist(t, bool(back)))


@_design(**_STRAIGHT, length=(0.5, 0.25, 0.95), fit=(0.4, 0.0, 1.0), flare=(0.25, 0.0, 1.0))
def _shift(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, _neck(o), o.fit, o.flare)
    _sleeved(t, m, o)


def _quarter(girth: float) -> tuple[float, float]:
    """A quarter of a waist of that girth [m] in two pieces; it is 2% wider than the body."""
    return 0.1275 * girth, 0.1275 * girth


def _skirt_with_band(t: Table, m: Measures, o: Options) -> None:
    skirt(t, m, o.ease, o.length, o.flare, _quarter(m.waist), m.waist_height)
    edges = {False: t.keys("skirt_front", "waist"), True: t.keys("skirt_back", "waist")}
    band(t, m, edges, o.band, m.waist_height + o.band)


_SKIRT: dict[str, Choices] = {"ease": (0.05, 0.02, 0.3), "length": (0.5, 0.3, 0.95), "band": (0.035, 0.03, 0.08)}


@_design(**_SKIRT, flare=(0.3, 0.0, 1.2))
def _skirt(t: Table, m: Measures, o: Options) -> None:
    _skirt_with_band(t, m, o)


@_design(**_SKIRT, flare=(-0.06, -0.12, 0.0))
def _pencil(t: Table, m: Measures, o: Options) -> None:
    _skirt_with_band(t, m, o)


@_design(length=(0.5, 0.2, 0.95), circle=(1.0, 0.3, 1.2), band=(0.035, 0.03, 0.08))
def _circle(t: Table, m: Measures, o: Options) -> None:
    middle = 0.5 * (m.front + m.back)
    _gores(t, 1.02 * m.waist, o.circle, o.length * m.waist_height, (m.waist_height, middle))
    band(t, m, {back: _gore_waist(t, back) for back in (False, True)}, o.band, m.waist_height + o.band)


def _rows(t: Table, m: Measures, length: float, count: int, gathers: float, height: float) -> None:
    """A waistband of two strips, and gathered rows below it."""
    edges, half = {}, 0.51 * m.waist
    for back in (False, True):
        name = f"band_{'back' if back else 'front'}"
        draw_strip(t, name, [half], [half], height, m.waist_height, trunk_place(m, back))
        edges[back] = t.keys(name, "below")
    t.sew_keys("band_front", "band_back", ["side"])
    tiers(t, m, edges, m.waist_height, length * m.waist_height, count, gathers)


@_design(length=(0.5, 0.2, 0.95), gathers=(1.7, 1.35, 2.5), band=(0.035, 0.03, 0.08))
def _gathered(t: Table, m: Measures, o: Options) -> None:
    _rows(t, m, o.length, 1, o.gathers, o.band)


@_design(length=(0.6, 0.3, 0.95), gathers=(1.4, 1.35, 1.7), tiers=(3.0, 2.0, 4.0), band=(0.035, 0.03, 0.08))
def _tiered(t: Table, m: Measures, o: Options) -> None:
    _rows(t, m, o.length, round(o.tiers), o.gathers, o.band)


def _trousers_with_band(t: Table, m: Measures, o: Options, knee: float, hem: float) -> None:
    top = m.waist_height + o.rise - o.band
    waist = float(np.interp(top, [m.hip_height, m.waist_height], [m.hips, m.waist]))
    legs(t, m, Leg(o.ease, knee, hem, o.length, top, _quarter(waist)))
    band(t, m, {back: _leg_waist(t, back) for back in (False, True)}, o.band, top + o.band)


_LEGS: dict[str, Choices] = {"rise": (-0.03, -0.07, 0.0), "band": (0.035, 0.03, 0.05)}


@_design(**_LEGS, ease=(0.06, 0.02, 0.3), length=(0.93, 0.65, 0.97), knee=(0.3, 0.1, 1.0), hem=(0.95, 0.7, 1.8))
def _trousers(t: Table, m: Measures, o: Options) -> None:
    _trousers_with_band(t, m, o, o.knee, o.hem)


@_design(**_LEGS, ease=(0.01, -0.03, 0.06), length=(0.85, 0.5, 0.88), knee=(0.05, 0.0, 0.15), hem=(1.1, 1.0, 1.3))
def _leggings(t: Table, m: Measures, o: Options) -> None:
    _trousers_with_band(t, m, o, o.knee, o.hem * m.ankle / m.knee)


@_design(**_LEGS, ease=(0.08, 0.03, 0.3), length=(0.3, 0.12, 0.55), hem=(1.1, 1.0, 1.5))
def _shorts(t: Table, m: Measures, o: Options) -> None:
    _trousers_with_band(t, m, o, 0.4, o.hem)


@_design(**_BODICE, length=(0.9, 0.12, 0.97), knee=(0.4, 0.15, 1.0), hem=(1.0, 0.7, 1.6))
def _jumpsuit(t: Table, m: Measures, o: Options) -> None:
    pieces = bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)
    legs(t, m, Leg(o.ease + 0.04, o.knee, o.hem, o.length, m.waist_height, pieces))
    for back, name in enumerate(("front", "back")):
        t.sew_all(t.keys(name, "hem"), _leg_waist(t, bool(back)))


@_design(length=(0.15, -0.1, 0.5), depth=(0.25, 0.15, 0.4), width=(0.3, 0.1, 0.5), shape=("round", "v"), sleeve=(0.5, 0.2, 0.7))
def _poncho(t: Table, m: Measures, o: Options) -> None:
    hem, wide = m.waist_height * (1.0 - o.length), 0.5 * m.shoulder_width + o.sleeve * m.arm_length
    for back in (False, True):
        (_, shoulder, neck), end = upper_half(m, back, 0.0, _neck(o))
        tip, inner = shoulder.start, neck.start
        drop = (inner[1] - tip[1]) / (inner[0] - tip[0]) * (wide - inner[0])
        half = [Side("hem", (0.0, hem)), Side("open", (wide, hem)), Side("shoulder", (wide, inner[1] + drop)), neck]
        t.draw("back" if back else "front", both_halves(half, end, back), *trunk_place(m, back))
    t.sew_keys("front", "back", ["shoulder"])


@_design(length=(0.1, -0.1, 0.6), circle=(0.8, 0.6, 1.0), ease=(0.25, 0.1, 0.5))
def _cape(t: Table, m: Measures, o: Options) -> None:
    long = m.neck_height - m.waist_height * (1.0 - o.length)
    _gores(t, m.neck * (1.0 + o.ease), o.circle, long, (m.neck_height + 0.01, m.shoulder[2]), 45.0)
