"""What makes frames bad: torn cloth, steps that ended too far from their minimum, skin and cloth through each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hood.assets.files.doubt import Doubt
from hood.dynamics.recorder import RolloutData
from hood.dynamics.verdict.cause import Cause, Found
from hood.dynamics.verdict.frames import name_frames
from hood.dynamics.verdict.guarded import guard_doubts
from hood.dynamics.verdict.solved import solved_causes
from hood.dynamics.verdict.surface import Drawn, apart_from_folds, beyond_start, surface_metrics, visible_crossings
from hood.limits import CROSSINGS_OF_START, CROSSINGS_UNSOUND, CUT_UNSOUND, DEPTH_UNSOUND, INSIDE_UNSOUND, STRAIN_UNSOUND
from hood.mesh.topology import unique_edges


def causes_of(data: RolloutData, seen: Drawn) -> Found:
    """All of a rollout, but for what is not finite and for parts that have come off."""
    metrics = {name: values for name, values in data.step_metrics.items() if values.shape == data.step_finite.shape}
    found = solved_causes(metrics) + skin_causes(surface_metrics(data, seen), metrics) + crossing_causes(data, seen)
    strain = strain_of(data)
    if strain is not None:
        found = Found([strain_cause(data.step_finite, strain)]) + found
    return found + guard_doubts(data)


def strain_cause(finite: np.ndarray, strain_p99: np.ndarray) -> Cause:
    """Torn cloth. A frame that is not finite is told as that."""
    limit = STRAIN_UNSOUND.value
    text = f"strain p99 is beyond {limit:.0%}"
    return Cause("strain", text, finite & ~(strain_p99 <= limit), strain_p99, limit, STRAIN_UNSOUND.unit, ".0%")


def strain_of(data: RolloutData) -> np.ndarray | None:
    """(S,) 99th percentile of the absolute edge strain, NaN in frames that are not finite; None where it is not known."""
    known = data.step_metrics.get("strain_p99")
    if known is not None and known.shape == data.step_finite.shape:
        return known
    if data.steps is not None:
        return None
    faces = data.cloth_faces if data.refined is None else data.refined.faces
    start, end = unique_edges(faces.astype(np.int64)).T
    finite, strain = data.step_finite, np.full(len(data.step_finite), np.nan)
    if len(start) == 0:
        return np.where(finite, 0.0, strain)
    rest = np.linalg.norm(data.rest_pos[end].astype(np.float64) - data.rest_pos[start], axis=1)
    for frame in np.flatnonzero(finite):
        pos = data.cloth_pos[frame].astype(np.float64)
        strain[frame] = np.quantile(np.abs(np.linalg.norm(pos[end] - pos[start], axis=1) / rest - 1.0), 0.99)
    return strain


def skin_causes(metrics: Mapping[str, np.ndarray], inside: Mapping[str, np.ndarray]) -> Found:
    """Skin through cloth, apart from folds of the skin, and cloth ``inside`` the body as far as a rollout measured it."""
    share, depth = apart_from_folds(metrics), metrics["skin_depth"]
    measured = np.isfinite(share)
    cut, deep = CUT_UNSOUND.value, DEPTH_UNSOUND.value
    causes = [
        Cause("skin_through_cloth", f"the skin cuts more than {cut:.0%} of the cloth's triangles", np.nan_to_num(share) > cut,
              share, cut, CUT_UNSOUND.unit, ".1%", measured=measured),
        Cause("skin_depth", f"skin sticks out of the cloth by more than {1e3 * deep:g} mm",
              (np.nan_to_num(depth) > deep) & (np.nan_to_num(share) > 0), depth, deep, "m", ".0f", 1e3, " mm", measured),
    ]  # fmt: skip
    if "penetration_share" in inside:
        share_inside = inside["penetration_share"]
        text = f"more than {INSIDE_UNSOUND.value:.0%} of the cloth's vertices are inside the body"
        causes.append(Cause("inside_body", text, np.nan_to_num(share_inside) > INSIDE_UNSOUND.value, share_inside,
                            INSIDE_UNSOUND.value, INSIDE_UNSOUND.unit, ".0%", measured=np.isfinite(share_inside)))  # fmt: skip
    folds = metrics["cut_face_share"] - share
    caught = np.nan_to_num(folds) > cut
    notes = []
    if caught.any():
        notes.append(
            f"the skin cuts up to {np.nanmax(folds):.1%} of the cloth's triangles where it passes through itself, in "
            f"{name_frames(caught)}: cloth cannot be outside both sides of such a fold, and this does not count"
        )
    return Found(causes, notes=notes)


_PAIRS = "pairs of triangles"
#: Metric → kind, and what passes through what.
_CROSSINGS = {
    "self_crossings": ("cloth_through_cloth", "cloth"),
    "garment_crossings": ("garments_through_each_other", "two garments"),
}


def crossing_causes(data: RolloutData, seen: Drawn) -> Found:
    """Cloth through cloth that a viewer sees, beyond what the start had."""
    metrics, found = surface_metrics(data, seen), Found()
    every_pair = sum(np.nan_to_num(metrics[name]) for name in _CROSSINGS)
    most = most_crossings(seen)
    looked = visible_crossings(seen, beyond_start(every_pair), most)
    hidden = bool(looked) and all(shown <= most for shown, _ in looked.values())
    for name, (kind, what) in _CROSSINGS.items():
        counts, new = metrics[name], beyond_start(metrics[name])
        text = f"more than {most} pairs of triangles of {what} pass through each other"
        bad = (new > most) & (not hidden)
        found += Found([Cause(kind, text, bad, counts, most, _PAIRS, ".0f", measured=np.isfinite(counts))])
        found += _of_start(counts, kind, what, seen)
    if hidden:
        frames = np.nan_to_num(every_pair) > most
        shown = max(shown for shown, _ in looked.values())
        found.notes.append(
            f"up to {int(np.nanmax(every_pair))} pairs of triangles of cloth pass through each other in {name_frames(frames)}, "
            f"of which no viewer sees more than {shown}: this does not count"
        )
    return found


def most_crossings(seen: Drawn) -> int:
    """Pairs of triangles along :data:`hood.limits.CROSSINGS_UNSOUND` of cloth: the finer the mesh, the more."""
    return max(1, round(CROSSINGS_UNSOUND.value / max(0.5 * seen.edge_length, 1e-6)))


def _of_start(counts: np.ndarray, kind: str, what: str, seen: Drawn) -> Found:
    """What frame 0 had already: of a garment's own folds a doubt, of more than that a reason."""
    first = float(counts[0]) if len(counts) and np.isfinite(counts[0]) else 0.0
    if first == 0:
        return Found()
    share = first / max(len(seen.faces), 1)
    text = f"{first:.0f} pairs of triangles of {what} pass through each other already in frame 0"
    if share > CROSSINGS_OF_START.value:
        still = np.nan_to_num(counts) / max(len(seen.faces), 1) > CROSSINGS_OF_START.value
        return Found([Cause(kind, f"{text}, and more than {CROSSINGS_OF_START.value:.0%} of the triangles still do", still,
                            counts, CROSSINGS_OF_START.value * len(seen.faces), _PAIRS, ".0f",
                            measured=np.isfinite(counts))])  # fmt: skip
    sentence = f"{text}; the file has them, or putting the garment on; repair the mesh where it was made, or wear a larger size"
    return Found(doubts=[Doubt("garment", sentence, (0,), first, _PAIRS)])
