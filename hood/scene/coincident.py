"""Garments of an outfit that lie in the same place, as a lining made of the garment itself: none is over the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

#: Vertices nearer than this [m] are in the same place, and garments where that is more than this share of one's vertices.
#: Seams that two garments share are fewer.
_SAME, _SHARE = 1e-5, 0.5


def layers_below(pos: Tensor, piece: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """On how many garments that lie in the same place each vertex of ``pos`` (V, 3) [m] comes to lie, (V,); 0 where on none.

    Args:
        piece: (V,) garment of a vertex.
        order: garments from the body outwards.
    """
    place = np.round(pos.detach().double().cpu().numpy() / _SAME).astype(np.int64)
    number = np.unique(place, axis=0, return_inverse=True)[1].reshape(-1)
    below = np.zeros(len(piece), np.int64)
    for rank, outer in enumerate(order):
        rows = np.flatnonzero(piece == outer)
        same = (np.isin(number[rows], number[piece == inner]).mean() > _SHARE for inner in order[:rank])
        below[rows] = sum(map(bool, same))
    return below
