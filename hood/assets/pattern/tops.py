"""Designs that hang from the shoulders: tops, dresses, overalls, capes."""

from __future__ import annotations

import math

import numpy as np

from hood.assets.pattern.blocks import (
    Leg,
    Neck,
    Side,
    Table,
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
from hood.assets.pattern.bottoms import gore_waist, gores, leg_waist
from hood.assets.pattern.fronts import lapels, open_front, quilted, ribbed, stand, turned_collar
from hood.assets.pattern.measures import Measures
from hood.assets.pattern.options import Choices, Design, Options, entered

#: Every design here by name.
TOPS: dict[str, Design] = {}


def _neck(o: Options, strap: float = 1.0, width: float | None = None) -> Neck:
    return Neck(o.depth, o.width if width is None else width, strap, o.shape)


def _sleeved(t: Table, m: Measures, o: Options, puff: float = 1.01) -> None:
    if o.sleeve >= 0.1:
        sleeves(t, m, o.ease, o.sleeve, o.wide, puff)


@entered(
    TOPS,
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


@entered(
    TOPS,
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


@entered(
    TOPS,
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
        stand(t, m, 0.035)


@entered(
    TOPS,
    ease=(0.12, 0.05, 0.5),
    length=(0.26, 0.1, 0.6),
    sleeve=(0.97, 0.4, 1.0),
    wide=(1.15, 0.8, 1.8),
    cuff=(0.06, 0.0, 0.1),
    collar=("turned", "stand", "none"),
    front=("buttons", "zip", "closed"),
    depth=(0.2, 0.12, 0.3),
    fit=(0.4, 0.0, 1.0),
)
def _blouse(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, Neck(o.depth, 0.04), o.fit)
    sleeves(t, m, o.ease, o.sleeve, o.wide, 1.01, o.cuff if o.cuff >= 0.02 else 0.0)
    if o.collar == "stand":
        stand(t, m, 0.035)
    elif o.collar == "turned":
        turned_collar(t, m, 0.03, 0.045, 0.07)
    open_front(t, o.front, *(["collar_front"] if o.collar != "none" else []), "front")


@entered(
    TOPS,
    ease=(0.25, 0.12, 0.5),
    length=(0.1, 0.0, 0.3),
    sleeve=(0.97, 0.4, 1.0),
    wide=(1.15, 0.9, 1.5),
    cuff=(0.06, 0.03, 0.1),
    band=(0.06, 0.03, 0.1),
    rib=(0.95, 0.8, 1.1),
    front=("zip", "buttons", "closed"),
    depth=(0.18, 0.12, 0.3),
)
def _bomber(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, Neck(o.depth, 0.06))
    sleeves(t, m, o.ease, o.sleeve, o.wide, 1.01, o.cuff)
    stand(t, m, 0.045)
    hem = m.waist_height * (1.0 - o.length)
    for back in (False, True):
        name = "back" if back else "front"
        cut = [length / 1.1 for length in t.lengths(t.keys(name, "hem"))]
        draw_strip(t, f"ribbing_{name}", cut, cut, o.band, hem - o.band, trunk_place(m, back))
        t.sew_all(t.keys(name, "hem"), t.keys(f"ribbing_{name}", "above"))
    t.sew_keys("ribbing_front", "ribbing_back", ["side"])
    around = np.interp(hem - 0.5 * o.band, [m.hip_height, m.waist_height], [m.hips, m.waist])
    ribbed(t, o.rib * around / (4.0 * cut[0]), "ribbing_front", "ribbing_back")
    ribbed(t, 0.82 * o.rib, *(f"{side}_cuff_{name}" for side in ("left", "right") for name in ("front", "back")))
    ribbed(t, 0.9, "collar_front", "collar_back")
    open_front(t, o.front, "collar_front", "front", "ribbing_front")


@entered(
    TOPS,
    ease=(0.25, 0.12, 0.5),
    length=(0.22, 0.08, 0.4),
    tube=(0.08, 0.06, 0.2),
    strap=(0.95, 0.8, 1.0),
    front=("zip", "buttons", "closed"),
    depth=(0.18, 0.12, 0.3),
)
def _gilet(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, Neck(o.depth, 0.06, o.strap))
    stand(t, m, 0.055)
    open_front(t, o.front, "collar_front", "front")
    quilted(t, o.tube, *(name for name in t.panels if "collar" not in name))


@entered(
    TOPS,
    ease=(0.18, 0.1, 0.5),
    length=(0.3, 0.12, 0.7),
    sleeve=(0.97, 0.6, 1.0),
    wide=(1.05, 0.9, 1.4),
    lapel=(0.085, 0.06, 0.11),
    front=("buttons", "closed"),
    depth=(0.8, 0.55, 0.95),
    fit=(0.4, 0.0, 1.0),
)
def _blazer(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, Neck(o.depth, 0.06, 1.0, "v"), o.fit)
    sleeves(t, m, o.ease, o.sleeve, o.wide)
    lapels(t, m, o.lapel, 0.045)
    open_front(t, o.front, "front", every=0.1)


@entered(
    TOPS,
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


@entered(TOPS, **_BODICE)
def _bodice(t: Table, m: Measures, o: Options) -> None:
    bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)


@entered(TOPS, **_BODICE, length=(0.5, 0.3, 0.95), flare=(0.0, -0.06, 0.8))
def _sheath(t: Table, m: Measures, o: Options) -> None:
    pieces = bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)
    skirt(t, m, o.ease, o.length, o.flare, pieces, m.waist_height)
    for name in ("front", "back"):
        t.sew_all(t.keys(name, "hem"), t.keys(f"skirt_{name}", "waist"))


@entered(TOPS, **_BODICE, length=(0.5, 0.2, 0.95), gathers=(1.6, 1.1, 2.5), tiers=(1.0, 1.0, 4.0))
def _dress(t: Table, m: Measures, o: Options) -> None:
    bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)
    edges = {back: t.keys("back" if back else "front", "hem") for back in (False, True)}
    count = round(o.tiers)
    tiers(t, m, edges, m.waist_height, o.length * m.waist_height, count, o.gathers if count == 1 else min(o.gathers, 1.7))


@entered(TOPS, **_BODICE, length=(0.5, 0.2, 0.95), circle=(0.75, 0.4, 1.2))
def _swing(t: Table, m: Measures, o: Options) -> None:
    ring = 4.0 * sum(bodice(t, m, o.ease, _neck(o)))
    _sleeved(t, m, o, o.puff)
    gores(t, ring, o.circle, o.length * m.waist_height, (m.waist_height, 0.5 * (m.front + m.back)))
    for back, name in enumerate(("front", "back")):
        t.sew_all(t.keys(name, "hem"), gore_waist(t, bool(back)))


@entered(TOPS, **_STRAIGHT, length=(0.5, 0.25, 0.95), fit=(0.4, 0.0, 1.0), flare=(0.25, 0.0, 1.0))
def _shift(t: Table, m: Measures, o: Options) -> None:
    torso(t, m, o.ease, o.length, _neck(o), o.fit, o.flare)
    _sleeved(t, m, o)


@entered(TOPS, **_BODICE, length=(0.9, 0.12, 0.97), knee=(0.4, 0.15, 1.0), hem=(1.0, 0.7, 1.6))
def _jumpsuit(t: Table, m: Measures, o: Options) -> None:
    pieces = bodice(t, m, o.ease, _neck(o))
    _sleeved(t, m, o, o.puff)
    legs(t, m, Leg(o.ease + 0.04, o.knee, o.hem, o.length, m.waist_height, pieces))
    for back, name in enumerate(("front", "back")):
        t.sew_all(t.keys(name, "hem"), leg_waist(t, bool(back)))


@entered(
    TOPS, length=(0.15, -0.1, 0.5), depth=(0.25, 0.15, 0.4), width=(0.3, 0.1, 0.5), shape=("round", "v"), sleeve=(0.5, 0.2, 0.7)
)
def _poncho(t: Table, m: Measures, o: Options) -> None:
    hem, wide = m.waist_height * (1.0 - o.length), 0.5 * m.shoulder_width + o.sleeve * m.arm_length
    for back in (False, True):
        (_, shoulder, neck), end = upper_half(m, back, 0.0, _neck(o))
        tip, inner = shoulder.start, neck.start
        drop = (inner[1] - tip[1]) / (inner[0] - tip[0]) * (wide - inner[0])
        half = [Side("hem", (0.0, hem)), Side("open", (wide, hem)), Side("shoulder", (wide, inner[1] + drop)), neck]
        t.draw("back" if back else "front", both_halves(half, end, back), *trunk_place(m, back))
    t.sew_keys("front", "back", ["shoulder"])


@entered(TOPS, length=(0.1, -0.1, 0.6), circle=(0.8, 0.6, 1.0), ease=(0.25, 0.1, 0.5))
def _cape(t: Table, m: Measures, o: Options) -> None:
    long = m.neck_height - m.waist_height * (1.0 - o.length)
    gores(t, m.neck * (1.0 + o.ease), o.circle, long, (m.neck_height + 0.01, m.shoulder[2]), 45.0)
