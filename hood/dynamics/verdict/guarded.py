"""What the guard of a rollout saw and did not mend."""

from __future__ import annotations

from hood.assets.files.doubt import Doubt
from hood.dynamics.alarms import CHECK, CUT, FORCE, INSIDE, STRAIN
from hood.dynamics.recorder import RolloutData
from hood.dynamics.step_repair import LEFT, NOT_TRIED
from hood.dynamics.verdict.cause import Found
from hood.dynamics.verdict.frames import mask_of, name_frames
from hood.limits import TOLERATED

#: Alarms of steps that the rule does not judge by itself, and what is so in such a frame.
_TEXTS = {
    STRAIN: "strain p99 beyond {limit:.0%}, {value:.0%} at worst",
    FORCE: "forces out of balance, {value:.3g} times the weight at worst",
    INSIDE: "vertices up to {value:.2g} m inside the body",
    CHECK: "a strain {value:.1%} away from the solver's",
    CUT: "the skin through {value:.1%} of the cloth's triangles at worst",
}


def guard_doubts(data: RolloutData) -> Found:
    """A doubt for each cause of alarms that were not mended in more than 2% of the steps."""
    doubts, steps = [], max(len(data.step_finite) - 1, 1)
    for cause, text in _TEXTS.items():
        rows = [row for row in data.alarms if row["cause"] == cause and row["repair"] in (NOT_TRIED, LEFT)]
        frames = sorted({int(row["frame"]) for row in rows})
        if len(frames) <= TOLERATED.value * steps:
            continue
        worst = max(rows, key=lambda row: row["value"])
        what = text.format(value=worst["value"], limit=worst["limit"])
        where = name_frames(mask_of(frames))
        sentence = f"the guard saw {what}, in {where}, and did not mend it; guard=repair, refine=5 or stepper=newton"
        doubts.append(Doubt("guard", sentence, tuple(frames), float(worst["value"])))
    return Found(doubts=doubts)
