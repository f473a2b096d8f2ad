"""Rotations of axis-angle vectors, of any array, and between two of them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


def from_vectors(vectors: np.ndarray) -> Rotation:
    """The rotations of vectors (M, 3) or (3,) [rad]. Arrays that cannot be written to, such as broadcast ones, are copied:
    scipy refuses them."""
    return Rotation.from_rotvec(np.require(vectors, np.float64, "W"))


def slerp(turns: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(T, J, 3) rad: axis-angle vectors at the times ``target`` (T,) of those (N, J, 3) at the times ``source`` (N,)."""
    result = np.zeros((len(target), *turns.shape[1:]))
    for joint in range(turns.shape[1]):
        if np.any(turns[:, joint]):
            result[:, joint] = Slerp(source, from_vectors(turns[:, joint]))(target).as_rotvec()
    return result
