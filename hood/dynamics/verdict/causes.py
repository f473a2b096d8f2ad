"""What makes frames bad: torn cloth, steps that ended too far from their minimum, skin and cloth through each other."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hood.assets.files.doubt import Doubt
from hood.dynamics.recorder import RolloutData
from hood.dynamics.verdict.cause import Cause, Found
from hood.dynamics.verdict.frames import name_frames
from hood.dynamics.verdict.guarded import guard_doubts
from hood.dynamics.verdict.skin import skin_causes
from hood.dynamics.verdict.solved import solved_causes
from hood.dynamics.verdict.surface import Meshes, surface_metrics, visible_crossings
from hood.dynamics.verdict.torn import strain_causes
from hood.limits import CROSSINGS_SEEN, CROSSINGS_UNSOUND
from hood.mesh.topology import unique_edges


def causes_of(data: RolloutData, meshes: Meshes, finite: np.ndarray, strain: np.ndarray | None) -> Found:
    """All of a rollout, but for what is not finite and for parts that have come off.

    Args:
        finite: (S,) bool, simulated frames that are finite.
        strain: of :func:`strain_of`.
    """
    metrics = {name: values for name, values in data.step_metrics.items() if values.shape == finite.shape}
    surface = surface_metrics(data, meshes)
    torn = Found() if strain is None else strain_causes(finite, strain, meshes)
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
    rest = np.linalg.norm(meshes.rest_pos[end] - meshes.rest_pos[start], axis=1)
    for frame in np.flatnonzero(finite):
        pos = meshes.cloth[frame].astype(np.float64)
        strain[frame] = np.quantile(np.abs(np.linalg.norm(pos[end] - pos[start], axis=1) / rest - 1.0), 0.99)
    return strain


_PAIRS = "pairs of triangles"
#: Metric → kind, and what passes through what.
_CROSSINGS = {
    "self_crossings": ("cloth_through_cloth", "cloth"),
    "garment_crossings": ("garments_through_each_other", "two garments"),
}


def crossing_causes(meshes: Meshes, metrics: Mapping[str, np.ndarray]) -> Found:
    """Cloth through cloth that a viewer sees."""
    found, edge = Found(), meshes.edge_length
    most, most_seen = pairs_along(CROSSINGS_UNSOUND.value, edge), pairs_along(CROSSINGS_SEEN.value, edge)
    every_pair = sum((np.nan_to_num(metrics[name]) for name in _CROSSINGS), np.zeros(len(metrics["self_crossings"])))
    looked = visible_crossings(meshes, every_pair, most)
    hidden = bool(looked) and all(shown <= most_seen for shown, _ in looked.values())
    for name, (kind, what) in _CROSSINGS.items():
        counts = metrics[name]
        text = f"more than {most} pairs of triangles of {what} pass through each other"
        first = counts[0] if len(counts) and np.isfinite(counts[0]) else 0.0
        start = f" (frame 0 has {first:.0f} already)" if first > 0 else ""
        bad = (np.nan_to_num(counts) > most) & (not hidden)
        found += Found([Cause(kind, text + start, bad, counts, most, _PAIRS, ".0f", measured=np.isfinite(counts))])
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
