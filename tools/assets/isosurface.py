"""The zero level of a scalar field on voxels as a triangle surface: one vertex per crossed voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


def zero_level(field: Array, origin: Array, voxel: float) -> tuple[Array, Faces]:
    """Vertices (V,3) [m] and faces (F,3) of the surface where ``field`` (nx,ny,nz) is zero; normals towards positive values.

    Surface nets (Gibson 1998): a vertex is the mean of the crossings on its voxel's edges, and every crossed grid edge
    joins the four voxels around it. Voxels at the rim of the grid are left out, so a surface that reaches it stays open.
    """
    inside = field < 0
    corners = _sum_of_corners(inside.astype(np.int8))
    active = (corners > 0) & (corners < 8)
    index = np.full(active.shape, -1, dtype=np.int64)
    index[active] = np.arange(int(active.sum()))
    total, count = np.zeros((int(active.sum()), 3)), np.zeros(int(active.sum()))
    quads = []
    for axis in range(3):
        low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        start = np.argwhere(inside[low] != inside[high])
        first, second = field[low][tuple(start.T)], field[high][tuple(start.T)]
        point = start.astype(np.float64)
        point[:, axis] += first / (first - second)
        around = _cells_around(start, axis, index)
        for column in around.T:
            valid = column >= 0
            np.add.at(total, column[valid], point[valid])
            np.add.at(count, column[valid], 1.0)
        whole = (around >= 0).all(axis=1)
        quad = around[whole]
        quads.append(np.where((first[whole] < 0)[:, None], quad, quad[:, ::-1]))
    verts = origin + voxel * total / count[:, None]
    return verts, _triangles(verts, np.concatenate(quads))


def _sum_of_corners(values: NDArray[np.int8]) -> NDArray[np.int8]:
    for axis in range(3):
        low = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        high = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        values = values[low] + values[high]
    return values


def _cells_around(start: Faces, axis: int, index: Faces) -> Faces:
    """(n,4) vertices of the voxels around grid edges that leave ``start`` (n,3) along ``axis``; -1 off the grid."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    columns = []
    for shift_one, shift_two in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
        cell = start.copy()
        cell[:, one] += shift_one
        cell[:, two] += shift_two
        valid = ((cell >= 0) & (cell < index.shape)).all(axis=1)
        column = np.full(len(cell), -1, dtype=np.int64)
        column[valid] = index[tuple(cell[valid].T)]
        columns.append(column)
    return np.stack(columns, axis=1)


def _triangles(verts: Array, quads: Faces) -> Faces:
    """Two triangles per quad (n,4), cut along its shorter diagonal."""
    a, b, c, d = quads.T
    short = np.linalg.norm(verts[a] - verts[c], axis=1) <= np.linalg.norm(verts[b] - verts[d], axis=1)
    first = np.where(short[:, None], np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(short[:, None], np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.concatenate([first, second])
