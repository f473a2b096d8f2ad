"""Garments of an outfit that lie in the same place, as a lining made of the garment itself: none is over the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

#: Vertices nearer than this [m] are in the same place, and garments where that is more than this share of one's vertices.
#: Seams that two garments share are fewer.
_SAME, _SHARE = 1e-5, 0.5


def lifted(pos: Tensor, piece: np.ndarray, order: Sequence[int], outside: Tensor, free: Tensor, gap: float) -> Tensor:
    """Positions (V, 3) [m] with outer garments moved out by ``gap`` [m] where they lie in an inner one; ``pos`` itself where
    none does.

    Args:
        piece: (V,) garment of a vertex.
        order: garments from the body outwards.
        outside: (V, 3) unit normals, away from the body.
        free: (V,) bool; the others stay.
    """
    place = np.round(pos.detach().double().cpu().numpy() / _SAME).astype(np.int64)
    _, number = np.unique(place, axis=0, return_inverse=True)
    number, above = number.reshape(-1), np.zeros(len(piece))
    for rank, outer in enumerate(order):
        rows = np.flatnonzero(piece == outer)
        for inner in order[:rank]:
            same = np.isin(number[rows], number[piece == inner])
            if same.mean() > _SHARE:
                above[rows] += 1.0
    if not above.any():
        return pos
    way = torch.as_tensor(gap * above).to(pos) * free.to(pos)
    return pos + way.unsqueeze(1) * outside.to(pos)
