"""What makes frames bad: torn cloth, steps that ended too far from their minimum, skin and cloth through each other.

What the guard of a rollout saw and did not mend.

How far the steps of a rollout ended from their minima: by the distance where it was measured, else by the force.

Torn cloth that a viewer sees.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hood.assets.files.said import Doubt
from hood.limits import (
    CROSSINGS_SEEN,
    CROSSINGS_UNSOUND,
    DISTANCE_FAR,
    DISTANCE_OFTEN,
    DISTANCE_UNSOUND,
    GRADIENT_UNSOUND,
    STRAIN_UNSOUND,
    TOLERATED,
)
from hood.mesh.topology import unique_edges
from hood.rollouts.checks.guard import CHECK, CUT, FORCE, INSIDE, STRAIN
from hood.rollouts.checks.step_repair import LEFT, NOT_TRIED
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.frames import Cause, FoundFrames, mask_of, name_frames, standing_for
from hood.rollouts.verdict.skin import skin_causes
from hood.rollouts.verdict.surface import Meshes, surface_metrics, visible, visible_crossings

#: Alarms of steps that the rule does not judge by itself, and what is so in such a frame.
_TEXTS = {
    STRAIN: "strain p99 beyond {limit:.0%}, {value:.0%} at worst",
    FORCE: "forces out of balance, {value:.3g} times the weight at worst",
    INSIDE: "vertices up to {value:.2g} m inside the body",
    CHECK: "a strain {value:.1%} away from the solver's",
    CUT: "the skin through {value:.1%} of the cloth's triangles at worst",
}


def guard_doubts(data: RolloutData) -> FoundFrames:
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
        sentence = f"the guard saw {what}, in {where}, and did not mend it; {_way_out(data)}"
        doubts.append(Doubt("guard", sentence, tuple(frames), float(worst["value"])))
    return FoundFrames(doubts=doubts)


def _way_out(data: RolloutData) -> str:
    if data.attributes.get("stepper") == "newton":
        return "these are the solver's own steps: look at fabric, size, forces and motion"
    return "guard=repair, refine=5 or stepper=newton"


#: The metric of :mod:`hood.rollouts.verdict.distance`.
DISTANCE = "distance_p99"


def solved_causes(metrics: Mapping[str, np.ndarray], dt: float) -> FoundFrames:
    """Bad steps of ``dt`` [s], of every stepper by the distance [m] where it was measured: more than one step, and one in four,
    beyond the limit, or one far beyond it. Elsewhere a solver is held to its target and, as a
    refinement, to the relative gradient; a network alone to nothing: its steps are no minima, and the force says little."""
    distance = metrics.get(DISTANCE)
    if distance is not None and np.isfinite(distance).any():
        limit, measured, way = DISTANCE_UNSOUND.value * dt, np.isfinite(distance), np.nan_to_num(distance)
        over, known = way > limit, standing_for(measured, measured)
        often = over.sum() > 1 and standing_for(over, measured).sum() > DISTANCE_OFTEN.value * known.sum()
        bad = way > (limit if often else DISTANCE_FAR.value * dt)
        text = f"steps ended more than {1e3 * limit:.2g} mm from their minimum (p99 over the vertices)"
        return FoundFrames([Cause("distance", text, bad, distance, limit, "m", ".0f", 1e3, " mm", measured)])
    found, converged, gradient = [], metrics.get("solver_converged"), _gradient(metrics)
    if converged is not None:
        found.append(Cause("solver_target", "the solver missed its target", converged == 0))
    if gradient is not None:
        found.append(_gradient_cause(gradient, "relative_gradient" in metrics))
    return FoundFrames(found)


def unknown_steps(metrics: Mapping[str, np.ndarray], judged: np.ndarray) -> np.ndarray | None:
    """(S,) bool: steps of which too little is known for a verdict, where these are too many; None where they are not.

    A step that met its solver's target has a small gradient.
    """
    distance, gradient = metrics.get(DISTANCE), _gradient(metrics)
    if gradient is None or (distance is not None and np.isfinite(distance).any()):
        return None
    unknown = judged & ~np.isfinite(gradient) & (np.arange(len(judged)) > 0)
    if metrics.get("solver_converged") is not None:
        unknown &= ~(metrics["solver_converged"] == 1)
    return unknown if unknown.sum() > TOLERATED.value * judged.sum() else None


def _gradient(metrics: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """(S,) relative gradient where steps are held to it, NaN where it was not computed; None for a network alone."""
    reached = metrics.get("refine_rg")
    if reached is None and "solver_converged" not in metrics:
        return None
    measured = metrics.get("relative_gradient")
    if measured is not None:
        return measured
    return np.full_like(metrics["solver_converged"], np.nan) if reached is None else reached


def _gradient_cause(gradient: np.ndarray, measured: bool) -> Cause:
    """``measured``: NaN is a gradient that is not finite, except at frame 0, and not one that nobody computed."""
    bad = gradient > GRADIENT_UNSOUND.value
    if measured:
        bad = bad | (np.isnan(gradient) & (np.arange(len(gradient)) > 0))
    text = f"the relative gradient is beyond {GRADIENT_UNSOUND.value:g}"
    return Cause("gradient", text, bad, gradient, GRADIENT_UNSOUND.value, GRADIENT_UNSOUND.unit)


#: Of the edges this share is beyond the 99th percentile; frames that are looked at from all sides, at most.
_SHARE, _LOOKED_AT = 0.01, 4


def strain_causes(finite: np.ndarray, strain_p99: np.ndarray, meshes: Meshes) -> FoundFrames:
    """Frames whose strain p99 is beyond the limit, unless what is stretched so far is pinched in a fold of the body where
    nobody sees it. A frame that is not finite is told as that."""
    limit = STRAIN_UNSOUND.value
    bad = finite & ~(strain_p99 <= limit)
    notes = []
    if bad.any() and _is_hidden(bad, meshes):
        worst = np.nanmax(np.where(bad, strain_p99, np.nan))
        notes.append(
            f"strain p99 is beyond {limit:.0%} in {name_frames(bad)}, {worst:.0%} at worst, in cloth that is pinched where no "
            "viewer sees it: this does not count"
        )
        bad = np.zeros_like(bad)
    text = f"strain p99 is beyond {limit:.0%}"
    return FoundFrames([Cause("strain", text, bad, strain_p99, limit, STRAIN_UNSOUND.unit, ".0%")], notes=notes)


def _is_hidden(bad: np.ndarray, meshes: Meshes) -> bool:
    """Whether in none of the bad frames a hundredth of the edges is seen to be stretched beyond the limit."""
    stored = {int(step): frame for frame, step in enumerate(meshes.step)}
    over = [stored[step] for step in np.flatnonzero(bad).tolist() if step in stored]
    if not over or not len(meshes.body_faces):
        return False
    edges = unique_edges(meshes.faces)
    places = np.unique(np.linspace(0, len(over) - 1, min(len(over), _LOOKED_AT)).astype(np.int64))
    for frame in [over[place] for place in places]:
        pos, body = meshes.cloth[frame].astype(np.float64), meshes.body[frame].astype(np.float64)
        if not np.isfinite(body).all():
            return False
        length = np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1)
        torn = edges[np.abs(length / meshes.rest_length - 1.0) > STRAIN_UNSOUND.value]
        shown = visible(pos[torn].mean(axis=1), [(pos, meshes.faces), (body, meshes.body_faces)])
        if shown.sum() > _SHARE * len(edges):
            return False
    return True


def causes_of(data: RolloutData, meshes: Meshes, finite: np.ndarray, strain: np.ndarray | None) -> FoundFrames:
    """All of a rollout, but for what is not finite and for parts that have come off.

    Args:
        finite: (S,) bool, simulated frames that are finite.
        strain: of :func:`strain_of`.
    """
    metrics = {name: values for name, values in data.step_metrics.items() if values.shape == finite.shape}
    surface = surface_metrics(data, meshes)
    torn = FoundFrames() if strain is None else strain_causes(finite, strain, meshes)
    return (
        torn
        + solved_causes(metrics, _step_of(data))
        + skin_causes(surface, metrics, meshes)
        + crossing_causes(meshes, surface)
        + guard_doubts(data)
    )


def _step_of(data: RolloutData) -> float:
    """The time step [s] of the simulated frames."""
    times = data.step_time
    return float(times[1] - times[0]) if len(times) > 1 else float(data.attributes.get("dt", 1.0))


def strain_of(data: RolloutData, meshes: Meshes, finite: np.ndarray) -> np.ndarray | None:
    """(S,) 99th percentile of the absolute edge strain, NaN in frames that are not ``finite`` (S,); None where it is not
    known."""
    known = data.step_metrics.get("strain_p99")
    if known is not None and known.shape == finite.shape:
        return known
    if data.steps is not None:
        return None
    start, end = unique_edges(meshes.faces).T
    strain = np.full(len(finite), np.nan)
    if len(start) == 0:
        return np.where(finite, 0.0, strain)
    rest = meshes.rest_length
    for frame in np.flatnonzero(finite):
        pos = meshes.cloth[frame].astype(np.float64)
        strain[frame] = np.quantile(np.abs(np.linalg.norm(pos[end] - pos[start], axis=1) / rest - 1.0), 0.99)
    return strain


_PAIRS = "pairs of triangles"
#: Metric → kind, and what passes through what in the sentences.
CROSSING_KINDS = {
    "self_crossings": ("cloth_through_cloth", "cloth"),
    "garment_crossings": ("garments_through_each_other", "two garments"),
}


def crossing_causes(meshes: Meshes, metrics: Mapping[str, np.ndarray]) -> FoundFrames:
    """Cloth through cloth that a viewer sees."""
    found, edge = FoundFrames(), meshes.edge_length
    most, most_seen = pairs_along(CROSSINGS_UNSOUND.value, edge), pairs_along(CROSSINGS_SEEN.value, edge)
    every_pair = sum((np.nan_to_num(metrics[name]) for name in CROSSING_KINDS), np.zeros(len(metrics["self_crossings"])))
    looked = visible_crossings(meshes, every_pair, most)
    hidden = bool(looked) and all(shown <= most_seen for shown, _ in looked.values())
    for name, (kind, what) in CROSSING_KINDS.items():
        counts = metrics[name]
        text = f"more than {most} pairs of triangles of {what} pass through each other"
        first = counts[0] if len(counts) and np.isfinite(counts[0]) else 0.0
        start = f" (frame 0 has {first:.0f} already)" if first > 0 else ""
        bad = (np.nan_to_num(counts) > most) & (not hidden)
        found += FoundFrames([Cause(kind, text + start, bad, counts, most, _PAIRS, ".0f", measured=np.isfinite(counts))])
        if 0 < first <= most:
            found.doubts.append(_of_start(first, what))
    if hidden:
        frames = every_pair > most
        shown = max(shown for shown, _ in looked.values())
        found.notes.append(
            f"up to {int(every_pair.max())} pairs of triangles of cloth pass through each other in {name_frames(frames)}, "
            f"of which no viewer sees more than {shown}: this does not count"
        )
    return found


def _of_start(first: float, what: str) -> Doubt:
    """A few pairs in frame 0: collars and pockets have them."""
    text = f"{first:.0f} pairs of triangles of {what} pass through each other already in frame 0"
    way_out = "the file has them, or putting the garment on; repair the mesh where it was made, or wear a larger size"
    return Doubt("garment", f"{text}; {way_out}", (0,), first, _PAIRS)


def pairs_along(length: float, edge: float) -> int:
    """Pairs of triangles along a ``length`` [m] of cloth with edges of ``edge`` [m]: the finer the mesh, the more."""
    return max(1, round(length / max(0.5 * edge, 1e-6)))
