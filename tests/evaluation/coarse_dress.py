"""The embedded dress with a third of its vertices: rollouts of a second or two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hood.assets.garment import Garment, load_garment
from hood.assets.isotropic import isotropic
from hood.assets.remesh import closest


def coarse_dress(num_vertices: int = 300) -> Garment:
    """Remeshed in its rest shape; what is known of vertices comes from the nearest points of the fine one, turns from the
    nearest vertices."""
    fine = load_garment("dress")
    pos, faces = isotropic(fine.rest_pos, fine.faces, num_vertices)
    hit = closest(pos, fine.rest_pos, fine.faces)
    corners, weights = fine.faces[hit.face.numpy()], hit.bary.numpy()
    nearest = corners[np.arange(len(pos)), weights.argmax(axis=1)]

    def mean(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else np.einsum("nk,nk...->n...", weights, values[corners].astype(np.float64))

    smooth = {key: mean(getattr(fine, key)) for key in ("lbs_weights", "shapedirs", "skin_pos")}
    marks = {key: getattr(fine, key)[nearest] for key in ("pinned", "rest_turn", "region", "stiffness")}
    none = dict.fromkeys(("uv", "uv_faces", "normal_faces", "colours", "coarse_edges"))
    return replace(fine, name="coarse dress", rest_pos=pos, faces=np.asarray(faces, np.int64), **smooth, **marks, **none)
