"""Whether a garment lies around a body where its file has it, so that nothing asks for another place."""

from __future__ import annotations

import numpy as np

from hood.assets.garment.openings import find_openings
from hood.assets.garment.placement import surrounds

#: A garment in its place has at most this share of its vertices inside the body, none deeper than this [m]: where a limb or
#: the trunk passes through a wall of cloth, it is deeper by more.
_MOST_INSIDE, _DEEPEST = 0.05, 0.02
#: Cloth that such a garment has on the sides opposite to its main side: one with openings, and a sheet. A cape far behind the
#: back has 0.22, see :func:`hood.assets.garment.placement.surrounds`.
_LEAST_ROUND, _SHEET_ROUND = 0.3, 0.15
#: Its middle vertex is nearer to the skin than this [m].
_FARTHEST = 0.35


def lies_in_place(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> bool:
    """Whether a garment ``pos`` (V, 3) [m], ``faces`` (F, 3) lies around the closed ``surface`` (W, 3) [m], ``body_faces``
    (G, 3): close, hardly inside, with a part of the body in every opening. Invariant to rigid motion of both."""
    around = surrounds(pos[np.unique(faces)], surface, body_faces)
    if around.middle > _FARTHEST or around.inside > _MOST_INSIDE or around.depth > _DEEPEST or around.roundness < _SHEET_ROUND:
        return False
    openings = find_openings(pos, faces, surface, body_faces)
    return openings.num_empty == 0 and (openings.num == 0 or around.roundness >= _LEAST_ROUND)
