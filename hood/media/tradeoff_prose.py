"""What the page of time against accuracy says in words."""

from __future__ import annotations

from hood.evaluation.bootstrap import DRAWS, LEVEL
from hood.evaluation.comparison import LEAST_ROLLOUTS, USEFUL
from hood.evaluation.gap import AGREEMENT
from hood.evaluation.reached import OVERSTRETCHED, Reached
from hood.evaluation.study import Study
from hood.evaluation.table import NEWTON
from hood.media.charts import FLOOR, below_floor

CHOICES = (
    "The cheapest setting whose median γ is below the limit with its whole interval, and whose strain stays within "
    f"{OVERSTRETCHED:g} times the converged solver's."
)
EQUAL_GAP = (
    "How long the solver alone takes to be as accurate, as a multiple of the setting's own time: above 1 the network earns its "
    "place. Between measured settings of the solver a straight line in the chart is assumed; where it was not measured as "
    "inaccurate or as accurate as the setting, only a bound is known (0 or ∞ at the other end). A verdict is given only where "
    "the whole interval lies on one side of 1; settings of the solver that overstretch the cloth do not count."
)
EQUAL_TIME = (
    "Beside every refined setting the most accurate network alone that takes no longer. A verdict is given only where the "
    "interval of the difference leaves out 0."
)
REFINED = (
    "Every iteration lowers the energy of its frame, but a rollout could still come out worse. So the same rollouts with and "
    "without: p99 strain, median over frames, beside that of the converged solver; share of vertices deeper than 2 mm under "
    "the skin and the deepest vertex, means over frames; and how many rollouts have more than without. Refinement leads to the "
    "solver's strain, up or down: worse is what has more strain than without and than the solver, or more penetration in the "
    "median rollout."
)
COMMANDS = (
    "Every point is one command; run it to check the point. It prints the point's table and writes it to outputs/evaluate. "
    "Flags say where figures are bounds or doubtful."
)


def introduction(study: Study) -> list[str]:
    """Paragraphs for people who have not seen γ before."""
    return [
        "Every frame of a cloth simulation asks for the positions that minimise one energy: stretching, bending, inertia, "
        "gravity, contact and friction together. A network guesses them in one go; a solver comes down step by step; a network "
        "refined by k iterations does a little of both. This page shows what each of them costs and how close it comes, on the "
        "states that it reaches by itself.",
        "γ (gamma) says how close: the energy that is left above the minimum, in units of e0, what it costs to be wrong about "
        "every vertex's acceleration by 1 g, the acceleration of free fall. The root of γ is about the error of the "
        "acceleration in g: γ = 1 is off by 1 g, γ = 0.01 by 0.1 g. At 30 frames per second 0.1 g is 1.1 mm per frame. "
        f"Smaller is better. Below about {AGREEMENT:g} the figure itself is uncertain: folded cloth has several minima, that "
        "far apart.",
        f"Measured on {study.device}, one thread per setting. Bars in the charts and ranges in brackets are {LEVEL:.0%} "
        "confidence intervals.",
    ]


def caption(study: Study, size: str) -> str:
    """What the chart of a size shows, and what it does not."""
    items = study.at(size)
    text = (
        "Left and down is better. Lines join iterations (numbers); squares and dashes are lower "
        "precision, dots sweeps; the broad band (left) is the Pareto front: settings that none beats in both time and γ."
    )
    if any(item.point.model == NEWTON for item in items):
        text += f" Hollow: p99 strain exceeds {OVERSTRETCHED:g} times the converged solver's, or a rollout broke down."
    else:
        text += " The converged solver was not measured at this size, so no strain is too much: only breakdowns are hollow."
    for quantity, name in (("gap", "median"), ("gap_p95", "95th percentile")):
        text += _below(below_floor(items, quantity), quantity, name)
    missing = [item.label for item in items if not item.charted]
    return text + (f" Without a γ and so not in the chart: {', '.join(missing)}." if missing else "")


def _below(below: list[Reached], quantity: str, name: str) -> str:
    if not below:
        return ""
    values = ", ".join(f"{item.label} ({getattr(item, quantity).value:.1e})" for item in below)
    point, verb, mark = ("point", "lies", "a triangle") if len(below) == 1 else ("points", "lie", "triangles")
    return (
        f" In the {name} {len(below)} {point} {verb} below the chart's floor of {FLOOR:g}: {values}; only the time is "
        f"shown, by {mark} at the lower edge."
    )


def method(study: Study) -> list[str]:
    """Paragraphs on how far the figures can be trusted."""
    states, unsure, apart, doubtful = (
        sum(getattr(i, name) for i in study.reached) for name in ("states", "unconverged", "disagreeing", "doubtful")
    )
    jobs = max((int(item.record.get("jobs", 1)) for item in study.reached), default=1)
    loads = [float(item.record["load_at_start"]) for item in study.reached if item.record.get("load_at_start") is not None]
    load = f" When a setting began the machine had {min(loads):.1f} to {max(loads):.1f} busy processes." if loads else ""
    return [
        "Times are wall-clock time from one frame to the next, search for contact, features, network and refinement included; "
        f"the first frames are left out. Up to {jobs} settings were measured side by side.{load}",
        "The minimum is the lowest of three minimisations in float64, from the inertial guess, the previous positions and the "
        f"setting's own result. Of {states:,} states, the reference of {unsure:,} missed its accuracy (γ is a lower bound "
        f"there) and minimisations of {apart:,} ended more than {AGREEMENT:g} e0 apart (the lowest counts), of {doubtful:,} by "
        "more than a tenth of γ as well; all are kept. "
        "A setting that beats every minimisation is the reference itself, with γ = 0, and counts as unconverged.",
        f"Intervals: rollouts are drawn again with replacement, then states within each, {DRAWS:,} times with a fixed seed, "
        "alike for all settings that were measured on the same rollouts; fewer rollouts give wider intervals. With a handful "
        f"they are too narrow all the same, so below {LEAST_ROLLOUTS} rollouts no verdict is given. They say how far other "
        f"rollouts of this kind would move a figure. Tables compare settings one by one at {LEVEL:.0%}; the sentence at the "
        "top looks at all settings of a size at once and asks for more certainty of each, so it may leave open what a table "
        f"decides. It considers settings whose γ is surely below {USEFUL:g}: faster ones that are further off are no choice.",
        "rg is the unbalanced force in units of the weight; p99 strain the 99th percentile of the change of edge lengths; both "
        "are medians over frames.",
    ]
