"""Rotations of axis-angle vectors, of any array."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def from_vectors(vectors: np.ndarray) -> Rotation:
    """The rotations of vectors (M, 3) or (3,) [rad]. Arrays that cannot be written to, such as broadcast ones, are copied:
    scipy refuses them."""
    return Rotation.from_rotvec(np.require(vectors, np.float64, "W"))
