"""What the skin does to the cloth's surface in a frame: triangles that it cuts, how far it sticks out, cloth through cloth.

Contact acts at the cloth's vertices, and ``penetration_*`` counts those. The flat triangles between them can cut the skin's
curve while every vertex is outside; that is what is measured here, from the two surfaces alone: nothing is shared with the
contact energy or its search.
"""

from __future__ import annotations

import numpy as np

from hood.assets.garment import Garment
from hood.mesh.crossing import crossings, self_crossings
from hood.mesh.skin import Sheet, skin_depth

SURFACE_METRICS = ("cut_face_share", "cut_edge_share", "skin_depth", "self_crossings", "garment_crossings")
#: Frames from one measurement to the next: 4 ms a frame at 1,000 vertices, 7 ms at 12,000.
SURFACE_STRIDE = 5
#: Cloth with a median edge of more than so many times that at rest is no garment any more.
TATTERS = 3.0


class SurfaceMeter:
    """Measures frames of one garment, or outfit, on one body.

    Args:
        garment: its faces and, of an outfit, which piece a vertex belongs to.
        body_faces: (G, 3); empty without a body.
    """

    def __init__(self, garment: Garment, body_faces: np.ndarray) -> None:
        self._faces, self._body_faces = np.asarray(garment.faces), np.asarray(body_faces).reshape(-1, 3)
        self._sheet = Sheet.of(self._faces)
        self._edges = self._sheet.edges
        self._lengths = _lengths(np.asarray(garment.rest_pos), self._edges)
        piece = np.zeros(len(garment.rest_pos), dtype=np.int64) if garment.piece is None else garment.piece
        self._piece = piece[self._faces[:, 0]]

    def __call__(self, pos: np.ndarray, body_pos: np.ndarray) -> dict[str, float]:
        """:data:`SURFACE_METRICS` of cloth (V, 3) and body (W, 3), both [m] in one frame.

        ``cut_face_share`` and ``cut_edge_share`` are the shares of the cloth's faces and edges that the body's surface cuts,
        ``skin_depth`` [m] is how far the body sticks out through them (:func:`hood.mesh.skin.skin_depth`). ``self_crossings``
        is the number of pairs of faces of one garment that pass through each other and share no vertex,
        ``garment_crossings`` that of faces of two garments of an outfit. What crossing means:
        :mod:`hood.mesh.crossing`.

        NaN where a position is not finite, and where the cloth is in tatters, its median edge more than :data:`TATTERS` times
        as long as at rest: nearly all of its triangles would have to be compared with each other, to say no more than that.
        """
        pos, body_pos = np.asarray(pos, dtype=np.float64), np.asarray(body_pos, dtype=np.float64)
        if not (np.isfinite(pos).all() and np.isfinite(body_pos).all()):
            return dict.fromkeys(SURFACE_METRICS, float("nan"))
        if len(self._edges) and np.median(_lengths(pos, self._edges)) > TATTERS * np.median(self._lengths):
            return dict.fromkeys(SURFACE_METRICS, float("nan"))
        cut = crossings(pos, self._faces, body_pos, self._body_faces)
        pairs = self_crossings(pos, self._faces)
        same = self._piece[pairs[:, 0]] == self._piece[pairs[:, 1]]
        values = (
            len(np.unique(cut.pairs[:, 0])) / max(len(self._faces), 1),
            len(np.unique(cut.first_edges[:, :2], axis=0)) / max(len(self._edges), 1),
            skin_depth(pos, self._faces, body_pos, self._body_faces, cut, self._sheet),
            float(same.sum()),
            float((~same).sum()),
        )
        return dict(zip(SURFACE_METRICS, values, strict=True))


def _lengths(pos: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1)
