"""Rigid motions of point sets."""

from __future__ import annotations

import numpy as np

from hood.mesh import surface_tree


def best_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that takes points (N, 3) about their middle nearest to others, by least squares (Kabsch)."""
    left, _, right = np.linalg.svd(end.T @ start)
    mirrored = np.linalg.det(left @ right) < 0.0
    return np.asarray(left @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ right)


def turned(start: np.ndarray, end: np.ndarray) -> float:
    """Degrees by which points (N, 3) turn about their middle, as far as they turn as one."""
    turn = best_turn(start - start.mean(axis=0), end - end.mean(axis=0))
    return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))))


def moved(start: np.ndarray, end: np.ndarray) -> tuple[float, float]:
    """Degrees as of :func:`turned`, and the longest way [m] of one of the points (N, 3) [m], N > 0."""
    return surface_tree.moved(start, end) or (turned(start, end), float(np.sqrt(np.square(end - start).sum(axis=1).max())))
