"""Whether a viewer can see a place: from one of many sides nothing of cloth and body lies before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Sides that are looked from: degrees around the vertical, and above the horizon. Nobody looks from under the floor.
_AROUND, _ABOVE = np.arange(0.0, 360.0, 30.0), (-15.0, 15.0, 45.0)
#: Width [m] of what is looked through, and how far [m] a place may lie behind the foremost surface there.
_CELL, _BEHIND = 0.008, 0.012
#: Surfaces are sampled a little finer than that.
_SPACING = 0.006
_MOST_PARTS = 24


def visible(places: np.ndarray, surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Which of ``places`` (N, 3) [m] can be seen, (N,) bool.

    Args:
        surfaces: positions (V, 3) [m] and faces (F, 3) of all that can hide them.
    """
    hidden = np.arange(len(places))  # so far: what one side sees is not asked for again
    if not len(hidden):
        return np.zeros(0, dtype=bool)
    points = np.concatenate([sampled(pos, faces) for pos, faces in surfaces]).T.copy()
    for towards in _directions():
        right, up = _across(towards)
        hidden = hidden[~_foremost(places[hidden].T, points, (right, up, towards))]
        if not len(hidden):
            break
    seen = np.ones(len(places), dtype=bool)
    seen[hidden] = False
    return seen


def _foremost(places: np.ndarray, points: np.ndarray, axes: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Which places (3, N) are not behind a point (3, M), seen along the third of the ``axes``."""
    right, up, towards = axes
    across, height = _along(right, places), _along(up, places)
    x = _along(right, points)
    points = points[:, (x >= across.min() - _CELL) & (x <= across.max() + _CELL)]
    y = _along(up, points)
    points = points[:, (y >= height.min() - _CELL) & (y <= height.max() + _CELL)]
    own, where = np.unique(_cells(across, height), return_inverse=True)
    cells = _cells(_along(right, points), _along(up, points))
    slot = np.searchsorted(own, cells).clip(max=len(own) - 1)
    within = own[slot] == cells
    front = np.full(len(own), -np.inf)
    np.maximum.at(front, slot[within], _along(towards, points)[within])
    return np.asarray(_along(towards, places) >= front[where] - _BEHIND)


def _cells(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(N,) numbers of the cells; those of torn cloth beyond 10,000 km are one."""
    column, row = (np.floor(np.clip(values / _CELL, -(2.0**30), 2.0**30)).astype(np.int64) for values in (x, y))
    return column * 2**31 + row


def _along(axis: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Coordinates (N,) of points (3, N); written out, as a product of matrices so narrow is slow in some libraries."""
    return np.asarray(axis[0] * points[0] + axis[1] * points[1] + axis[2] * points[2])


def sampled(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Points (M, 3) of a surface, no farther than some millimetres from each other."""
    corners = pos[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.clip(np.ceil(longest / _SPACING), 1, _MOST_PARTS).astype(np.int64)
    clouds = [pos]
    for count in np.unique(parts):
        weights = _grid(int(count))
        clouds.append(np.einsum("wk,fkx->fwx", weights, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(clouds)


def _grid(parts: int) -> np.ndarray:
    """Barycentric weights (W, 3) of the middles of a triangle's ``parts``² pieces."""
    rows = []
    for i in range(parts):
        for j in range(parts - i):
            rows.append((i + 1 / 3, j + 1 / 3))
            if i + j < parts - 1:
                rows.append((i + 2 / 3, j + 2 / 3))
    first, second = np.array(rows).T / parts
    return np.stack([first, second, 1.0 - first - second], axis=1)


def _directions() -> np.ndarray:
    """Unit vectors (D, 3) towards the viewer, y up."""
    around, above = (values.ravel() for values in np.meshgrid(np.radians(_AROUND), np.radians(_ABOVE)))
    return np.stack([np.cos(above) * np.sin(around), np.sin(above), np.cos(above) * np.cos(around)], axis=1)


def _across(towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    return right, np.cross(towards, right)
