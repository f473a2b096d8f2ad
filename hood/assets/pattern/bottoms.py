"""Designs that hang from the waist: skirts and trousers."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.pattern.blocks import XY, Leg, Side, SideKey, Table, band, draw_strip, legs, skirt, tiers, trunk_place
from hood.assets.pattern.measures import Measures
from hood.assets.pattern.options import Choices, Design, Options, entered

#: Every design here by name.
BOTTOMS: dict[str, Design] = {}


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
    names = ["gore_back_right", "gore_front_right", "gore_front_left", "gore_back_left"]
    for name, around in zip(names, (-135.0, -45.0, 45.0, 135.0), strict=True):
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
