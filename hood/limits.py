"""Limits that decide what is said of a result: each with its unit, the module that it belongs to and the reason for its value.

Everything that calls a rollout unsound, doubts an input or raises an alarm takes its number from here. Limits of one quantity
stand beside each other, so that it is seen why they differ.
"""

from __future__ import annotations

from typing import NamedTuple


class Limit(NamedTuple):
    """A number beyond which something is said."""

    value: float
    unit: str
    owner: str  # module that applies it
    reason: str


class Range(NamedTuple):
    """Least and most of what is known of a quantity."""

    least: float
    most: float
    unit: str
    owner: str
    reason: str


_RULE, _CAUSES, _SKIN = "hood.rollouts.verdict.rule", "hood.rollouts.verdict.causes", "hood.rollouts.verdict.skin"
_WORN, _DOUBTS, _GUARD = "hood.rollouts.verdict.unworn", "hood.rollouts.verdict.doubts", "hood.rollouts.checks.guard"

#: Of the frames that are judged this share may be bad.
TOLERATED = Limit(0.02, "share of frames", _RULE, "one frame in fifty is not seen in a film")
#: Frames at the beginning that may settle; they are judged only where there are no others.
SETTLING = Limit(5, "frames", _RULE, "a start by relaxing steps swings for a sixth of a second")

#: Strain, the 99th percentile over the edges. What is torn is unsound; what no ordinary fabric does makes the guard look at the
#: step; what would snap back makes the start be smoothed.
STRAIN_UNSOUND = Limit(0.5, "share of the length", _CAUSES, "soft, heavy and tight cloth reaches 40%, torn cloth 80%")
STRAIN_TORN = Limit(1.0, "share of the length", _RULE, "torn also where the start still settles: no start has swung so")
STRAIN_ALARM = Limit(0.25, "share of the length", _GUARD, "seven garments on four motions reach 19%")
STRAIN_RATIO = Limit(1.5, "times the solver's strain", _GUARD, "soft, heavy and tight cloth is strained so by the solver, too")
STRAIN_START = Limit(0.04, "share of the length", "hood.scene.start", "more would show as a jerk in frame 1")

#: How far the 99th percentile of the vertices still had to go to the minimum of a step, over the time step: 25 mm at 30 fps.
DISTANCE_UNSOUND = Limit(0.75, "m/s", _CAUSES, "of 374 rollouts the right ones, but for one, reach 0.68")
DISTANCE_OFTEN = Limit(0.25, "share of frames", _CAUSES, "fewer such steps are mended by the next ones")
DISTANCE_FAR = Limit(1.5, "m/s", _CAUSES, "one step beyond it is seen")
#: Where no distance was measured: the unbalanced force over the weight.
GRADIENT_UNSOUND = Limit(100.0, "times the weight", _CAUSES, "a rough estimate, up to ten times too high or too low")

#: Skin through cloth, apart from folds of the skin.
CUT_UNSOUND = Limit(0.01, "share of the cloth's triangles", _SKIN, "pictures show ten of a thousand triangles")
CUT_FLASH = Limit(0.02, "share of the cloth's triangles", _RULE, "seen in a single frame; right rollouts show 1.0%")
CUT_ALARM = Limit(0.02, "share of the cloth's triangles", _GUARD, "28 ordinary rollouts reach 0.42% at most")
DEPTH_UNSOUND = Limit(0.01, "m", _SKIN, "skin that sticks out so far is seen from every side")
DEPTH_GROSS = Limit(0.03, "m", _RULE, "a hand that has gone through the cloth: one frame is seen")
SPOTS_UNSOUND = Limit(0.002, "share of the cloth's triangles", _SKIN, "four of two thousand: smaller spots are not seen")
SPOTS_HEIGHT = Limit(0.0015, "m", _SKIN, "lower spots flicker")
SPOTS_LASTING = Limit(0.35, "share of frames", _SKIN, "spots that come and go are not seen")
#: Larger spots count where they last less long.
SPOTS_LARGE = Limit(
    0.004, "share of the cloth's triangles", _SKIN, "498 rollouts: right ones have them in at most one measured frame"
)
SPOTS_LARGE_LASTING = Limit(0.20, "share of frames", _SKIN, "right rollouts have them in 0.14")
#: Cloth that is under the skin as a whole cuts nothing.
INSIDE_UNSOUND = Limit(0.05, "share of the vertices", _SKIN, "2 mm deep in the body; ordinary rollouts have less than 1%")
INSIDE_ALARM = Limit(0.01, "m", _GUARD, "contact pushes out from 10 mm, from deeper it may push through the limb")
#: Cloth through cloth where a viewer can see it: the length along which pairs of triangles are counted.
CROSSINGS_UNSOUND = Limit(0.4, "m", _CAUSES, "the length of a forearm; shorter ones look like a fold")
CROSSINGS_SEEN = Limit(0.25, "m", _CAUSES, "the length of a hand, of what a viewer can see of them")

#: Worn, see hood.rollouts.verdict.worn.
AWAY_UNSOUND = Limit(0.18, "m", _WORN, "417 rollouts: worn at most 0.11, come off 0.19 and more, or slip")
SLIPPED_UNSOUND = Limit(0.15, "m", _WORN, "498 rollouts: worn at most 0.14, come off at least 0.15")
SUNK_UNSOUND = Limit(0.06, "m", _WORN, "498 rollouts: worn at most 0.04, come off at least 0.07")
SHIFTED_UNSOUND = Limit(0.20, "m", _WORN, "374 rollouts: worn at most 0.16, wound round the trunk 0.24")
SUNK_SETTLING = Limit(0.12, "m", _WORN, "worn at most 0.11 (one band excepted); come off at least 0.14")

#: The body.
HEAD_DOWN = Limit(0.5, "share of frames", _DOUBTS, "cartwheels are shorter, and handstands stand on the hands")
FLOOR_OFF = Limit(0.3, "m", _DOUBTS, "soles and recorded floors differ by less")
BODY_SPEED = Limit(12.0, "m/s", _DOUBTS, "the fastest sprint is 12.4 m/s, captured motions reach 3")
BODY_OVERLAP = Limit(0.0175, "share of the body's triangles", _DOUBTS, "jumps have 1.2%, squats 2.3%, arms in the trunk 3.6%")
BODY_JUMP = Limit(5.0, "m/s", _DOUBTS, "faster than in the steps around; captured motions reach 0.3")

#: Fabrics.
DENSITY_KNOWN = Range(0.005, 1.2, "kg/m²", _DOUBTS, "silk gauze to coats of leather")
SHEAR_KNOWN = Range(1.0, 1e6, "N/m", _DOUBTS, "nets to sailcloth")
STRETCH_KNOWN = Range(5.0, 1e7, "N/m", _DOUBTS, "fishnet to sailcloth")
BENDING_KNOWN = Range(0.0, 0.1, "N·m", _DOUBTS, "threads to saddle leather")
