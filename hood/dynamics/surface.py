"""What the skin does to the cloth's surface in a frame: triangles that it cuts, how far it sticks out, cloth through cloth.

Contact acts at the cloth's vertices, and ``penetration_*`` counts those. The flat triangles between them can cut the skin's
curve while every vertex is outside; that is what is measured here, from the two surfaces alone: nothing is shared with the
contact energy or its search.
"""

from __future__ import annotations

import numpy as np

from hood.assets.garment.garment import Garment
from hood.mesh.compiled_crossing import Eights, eights
from hood.mesh.crossing import crossings, self_crossings
from hood.mesh.skin import Sheet, skin_depth

SURFACE_METRICS = ("cut_face_share", "cut_edge_share", "skin_depth", "self_crossings", "garment_crossings", "cut_in_folds")
#: Frames from one measurement to the next: less than 1 ms a frame at 1,000 vertices, 1 ms at 12,000.
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
        lengths = _lengths(np.asarray(garment.rest_pos), self._edges)
        self._longest = TATTERS * float(np.median(lengths)) if len(lengths) else np.inf
        self._cloth = eights(self._faces, garment.rest_pos)
        self._body: Eights | None = None
        piece = np.zeros(len(garment.rest_pos), dtype=np.int64) if garment.piece is None else garment.piece
        self._piece = piece[self._faces[:, 0]]

    def __call__(self, pos: np.ndarray, body_pos: np.ndarray) -> dict[str, float]:
        """:data:`SURFACE_METRICS` of cloth (V, 3) and body (W, 3), both [m] in one frame.

        ``cut_face_share`` and ``cut_edge_share`` are the shares of the cloth's faces and edges that the body's surface cuts,
        ``skin_depth`` [m] is how far the body sticks out through them (:func:`hood.mesh.skin.skin_depth`). ``self_crossings``
        is the number of pairs of faces of one garment that pass through each other and share no vertex,
        ``garment_crossings`` that of faces of two garments of an outfit. What crossing means:
        :mod:`hood.mesh.crossing`. ``cut_in_folds`` is the part of ``cut_face_share`` whose faces are caught where the body
        passes through itself, as in the bend of an elbow, see :func:`in_folds`.

        NaN where a position is not finite, and where the cloth is in tatters, its median edge more than :data:`TATTERS` times
        as long as at rest: nearly all of its triangles would have to be compared with each other, to say no more than that.
        """
        pos, body_pos = np.asarray(pos, dtype=np.float64), np.asarray(body_pos, dtype=np.float64)
        if not (np.isfinite(pos).all() and np.isfinite(body_pos).all()):
            return dict.fromkeys(SURFACE_METRICS, float("nan"))
        if self._in_tatters(pos):
            return dict.fromkeys(SURFACE_METRICS, float("nan"))
        cloth, self._body = self._cloth, self._body or eights(self._body_faces, body_pos)
        both = None if cloth is None or self._body is None else (cloth, self._body)
        cut = crossings(pos, self._faces, body_pos, self._body_faces, both)
        pairs = self_crossings(pos, self._faces, cloth)
        same = self._piece[pairs[:, 0]] == self._piece[pairs[:, 1]]
        values = (
            _num_groups(cut.pairs[:, :1]) / max(len(self._faces), 1),
            _num_groups(cut.first_edges[:, :2]) / max(len(self._edges), 1),
            skin_depth(pos, self._faces, body_pos, self._body_faces, cut, self._sheet, both),
            float(same.sum()),
            float((~same).sum()),
            _num_groups(cut.pairs[in_folds(cut.pairs[:, 1], body_pos, self._body_faces, self._body), :1])
            / max(len(self._faces), 1),
        )
        return dict(zip(SURFACE_METRICS, values, strict=True))

    def _in_tatters(self, pos: np.ndarray) -> bool:
        lengths = _lengths(pos, self._edges)
        longer = 2 * int(np.count_nonzero(lengths > self._longest))
        # The median lies between two lengths where these are half of them.
        return longer > len(lengths) or (longer == len(lengths) > 0 and bool(np.median(lengths) > self._longest))


def in_folds(cutting: np.ndarray, body_pos: np.ndarray, body_faces: np.ndarray, body: Eights | None = None) -> np.ndarray:
    """Which of the faces ``cutting`` (N,) of a body are in a fold, (N,) bool: they pass through another face of it, or share a
    vertex with one that does. Cloth between two parts of a body that are in one place cannot be outside both.

    ``body``: :func:`hood.mesh.compiled_crossing.eights` of the faces, where they are known.
    """
    if not len(cutting):
        return np.zeros(0, dtype=bool)
    through = np.zeros(len(body_pos), dtype=bool)
    through[body_faces[np.unique(self_crossings(body_pos, body_faces, body))]] = True
    return np.asarray(through[body_faces[cutting]].any(axis=1))


def _num_groups(rows: np.ndarray) -> int:
    """Different ones among sorted rows."""
    return int((rows[1:] != rows[:-1]).any(axis=1).sum()) + 1 if len(rows) else 0


def _lengths(pos: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1)
