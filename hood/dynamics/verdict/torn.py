"""Torn cloth that a viewer sees."""

from __future__ import annotations

import numpy as np

from hood.dynamics.verdict.cause import Cause, Found
from hood.dynamics.verdict.frames import name_frames
from hood.dynamics.verdict.surface import Meshes
from hood.dynamics.verdict.visible import visible
from hood.limits import STRAIN_UNSOUND
from hood.mesh.topology import unique_edges

#: Of the edges this share is beyond the 99th percentile; frames that are looked at from all sides, at most.
_SHARE, _LOOKED_AT = 0.01, 4


def strain_causes(finite: np.ndarray, strain_p99: np.ndarray, meshes: Meshes) -> Found:
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
    return Found([Cause("strain", text, bad, strain_p99, limit, STRAIN_UNSOUND.unit, ".0%")], notes=notes)


def _is_hidden(bad: np.ndarray, meshes: Meshes) -> bool:
    """Whether in none of the bad frames a hundredth of the edges is seen to be stretched beyond the limit."""
    stored = {int(step): frame for frame, step in enumerate(meshes.step)}
    over = [stored[step] for step in np.flatnonzero(bad).tolist() if step in stored]
    if not over or not len(meshes.body_faces):
        return False
    edges = unique_edges(meshes.faces)
    rest = np.linalg.norm(meshes.rest_pos[edges[:, 1]] - meshes.rest_pos[edges[:, 0]], axis=1)
    places = np.unique(np.linspace(0, len(over) - 1, min(len(over), _LOOKED_AT)).astype(np.int64))
    for frame in [over[place] for place in places]:
        pos, body = meshes.cloth[frame].astype(np.float64), meshes.body[frame].astype(np.float64)
        if not np.isfinite(body).all():
            return False
        length = np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1)
        torn = edges[np.abs(length / rest - 1.0) > STRAIN_UNSOUND.value]
        shown = visible(pos[torn].mean(axis=1), [(pos, meshes.faces), (body, meshes.body_faces)])
        if shown.sum() > _SHARE * len(edges):
            return False
    return True
