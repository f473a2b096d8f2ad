"""Points that follow a surface without skinning weights: carried along by the vertices next to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

#: Body vertices whose motion a garment vertex without skin follows; enough to turn as a limb does, not as a facet does.
_NEIGHBOURS = 24
#: Distance [m] below which neighbours count the same.
_SOFTENING = 0.02


@dataclass(frozen=True)
class Anchors:
    """What each garment vertex follows: neighbours (V, K) on the body, their shares, and where all were at first."""

    neighbours: np.ndarray
    shares: np.ndarray  # (V, K), rows sum to one
    arms: np.ndarray  # (V, K, 3) m, neighbours about their centre
    offset: np.ndarray  # (V, 3) m, garment vertex from that centre

    def carried(self, points: np.ndarray) -> np.ndarray:
        """(V, 3) m: moved as the best rigid motion of each vertex's neighbours (Kabsch) to ``points`` (W, 3)."""
        now = points[self.neighbours]
        centre = (self.shares[:, :, None] * now).sum(axis=1)
        spread = np.einsum("vk,vka,vkb->vab", self.shares, now - centre[:, None], self.arms)
        left, _, right = np.linalg.svd(spread)
        # A mirror image is no motion: the weakest direction is turned back.
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        return centre + np.einsum("vab,vb->va", left @ right, self.offset)


def anchors(pos: np.ndarray, points: np.ndarray) -> Anchors:
    """What carries ``pos`` (V, 3) [m] along with the vertices ``points`` (W, 3) of a surface."""
    count = min(_NEIGHBOURS, len(points))
    dist, neighbours = cKDTree(points).query(pos, k=list(range(1, count + 1)))
    shares = 1.0 / (dist**2 + _SOFTENING**2)
    shares /= shares.sum(axis=1, keepdims=True)
    near = points[neighbours]
    centre = (shares[:, :, None] * near).sum(axis=1)
    return Anchors(neighbours, shares, near - centre[:, None], pos - centre)
