"""Skin through cloth and cloth through cloth in the frames of a rollout: what is seen, what the start had, what nobody sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hood.assets.garment.garment import Garment
from hood.dynamics.recorder import RolloutData
from hood.dynamics.surface import SURFACE_METRICS, SurfaceMeter
from hood.dynamics.verdict.visible import visible
from hood.mesh.crossing import self_crossings
from hood.mesh.topology import unique_edges

#: Frames that are measured where the rollout has not, and in which places are looked at from all sides, at most.
_MEASURED, _LOOKED_AT = 12, 4
#: Moments nearer [s] than this are the same.
_SAME = 1e-6


@dataclass(frozen=True)
class Meshes:
    """The simulated mesh of a rollout in its stored frames, and the body."""

    cloth: np.ndarray  # (T, V, 3) m
    faces: np.ndarray  # (F, 3)
    rest_pos: np.ndarray  # (V, 3) m
    body: np.ndarray  # (T, W, 3) m
    body_faces: np.ndarray  # (G, 3)
    piece: np.ndarray | None  # (V,) garment of an outfit
    step: np.ndarray  # (T,) the simulated frame of each, or the nearest
    pinned: np.ndarray  # (P,) vertices that are held, as far as the file says

    @property
    def edge_length(self) -> float:
        """The median of its edges at rest [m]."""
        start, end = unique_edges(self.faces.astype(np.int64)).T
        return float(np.median(np.linalg.norm(self.rest_pos[end] - self.rest_pos[start], axis=1))) if len(start) else 0.0


def meshes_of(data: RolloutData) -> Meshes:
    """Of a rollout that was read back."""
    faces = data.cloth_faces[: len(data.cloth_faces) - data.riding[1]]
    count = data.cloth_pos.shape[1] - data.riding[0]
    if data.refined is not None:
        faces, count = data.refined.faces, data.refined.num_coarse
    piece = data.still.get("piece")
    times = data.step_time
    step = np.abs(times[None] - data.time[:, None]).argmin(axis=1) if data.steps is not None else np.arange(len(data.time))
    return Meshes(
        data.cloth_pos[:, :count],
        np.asarray(faces, dtype=np.int64),
        np.asarray(data.rest_pos[:count], dtype=np.float64),
        data.body_pos,
        np.asarray(data.body_faces, dtype=np.int64),
        None if piece is None else piece[:count],
        step,
        data.still.get("pinned", np.zeros(0, dtype=np.int64)).astype(np.int64),
    )


def surface_metrics(data: RolloutData, meshes: Meshes) -> dict[str, np.ndarray]:
    """:data:`hood.dynamics.surface.SURFACE_METRICS` (S,) of the simulated frames, NaN where not measured; of a rollout that
    measured none a dozen of its stored frames are, of those that were simulated."""
    found = {name: data.step_metrics[name] for name in SURFACE_METRICS if name in data.step_metrics}
    if "cut_face_share" in found and np.isfinite(found["cut_face_share"]).any():
        return found
    count = len(data.step_finite)
    table = {name: np.full(count, np.nan) for name in SURFACE_METRICS}
    simulated = np.flatnonzero(np.abs(data.step_time[meshes.step] - data.time) < _SAME)
    if not len(simulated) or not len(meshes.faces):
        return table
    garment = Garment("", meshes.rest_pos, meshes.faces, np.zeros(len(meshes.rest_pos), dtype=bool), piece=meshes.piece)
    meter = SurfaceMeter(garment, meshes.body_faces)
    places = np.unique(np.linspace(0, len(simulated) - 1, _MEASURED).astype(np.int64))
    for frame in simulated[places].tolist():
        for name, value in meter(meshes.cloth[frame], meshes.body[frame]).items():
            table[name][meshes.step[frame]] = value
    return table


def visible_crossings(meshes: Meshes, counts: np.ndarray, most: float) -> dict[int, tuple[int, int]]:
    """Pairs of triangles of cloth through each other, of one garment or of two, that a viewer can see.

    Args:
        counts: (S,) pairs of the simulated frames, NaN where not measured.
        most: frames with more are of interest; the worst of them and some others are looked at.

    Returns:
        By simulated frame: how many of the pairs are seen, and how many there are.
    """
    stored = {int(step): frame for frame, step in enumerate(meshes.step)}
    over = [step for step in np.flatnonzero(np.nan_to_num(counts) > most).tolist() if step in stored]
    if not over:
        return {}
    worst = max(over, key=lambda step: counts[step])
    places = np.unique(np.linspace(0, len(over) - 1, min(len(over), _LOOKED_AT)).astype(np.int64))
    chosen = sorted({worst, *(over[place] for place in places)})
    return {step: _seen_at(meshes, stored[step]) for step in chosen}


def _seen_at(meshes: Meshes, frame: int) -> tuple[int, int]:
    pos, body = meshes.cloth[frame].astype(np.float64), meshes.body[frame].astype(np.float64)
    pairs = self_crossings(pos, meshes.faces)
    places = pos[meshes.faces[pairs]].mean(axis=(1, 2))
    return int(visible(places, [(pos, meshes.faces), (body, meshes.body_faces)]).sum()), len(pairs)


def spread_over(values: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """``values`` (S,) with those that are NaN taken from the nearest known one, in ``measured`` frames; 0 elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return np.zeros(len(values))
    nearest = known[np.abs(np.arange(len(values))[:, None] - known[None]).argmin(axis=1)]
    return np.where(measured, values[nearest], 0.0)
