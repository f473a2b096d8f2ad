"""Synthetic meshes: grids, strips, cylinders, spheres, boxes."""

from __future__ import annotations

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]


def grid(n: int = 8, m: int = 8, size: float = 1.0) -> Mesh:
    """Horizontal square sheet (y = 0) of n × m vertices and side ``size`` [m]; normals up."""
    x, z = np.meshgrid(np.linspace(0, size, n), np.linspace(0, size, m), indexing="ij")
    pos = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m - 1), indexing="ij")
    return pos, _split_quads(i.reshape(-1), j.reshape(-1), m, n * m)


def strip(n: int = 8, length: float = 1.0, width: float = 0.1) -> Mesh:
    """Horizontal strip of 2n vertices, ``length`` along x and ``width`` along z [m]."""
    pos, faces = grid(n, 2, 1.0)
    return pos * np.array([length, 1.0, width]), faces


def cylinder(around: int = 12, rows: int = 6, radius: float = 0.2, height: float = 0.5) -> Mesh:
    """Open tube about the y axis, outward normals; vertex ``k`` of row ``r`` has index ``r * around + k``."""
    y, angle = np.meshgrid(np.linspace(0, height, rows), 2 * np.pi * np.arange(around) / around, indexing="ij")
    pos = np.stack([radius * np.cos(angle), y, -radius * np.sin(angle)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(around), indexing="ij")
    return pos, _split_quads(i.reshape(-1), j.reshape(-1), around, rows * around)


def sphere(subdivisions: int = 2, radius: float = 1.0) -> Mesh:
    """Icosahedron subdivided ``subdivisions`` times, outward normals; 10 · 4ⁿ + 2 vertices."""
    golden = (1 + np.sqrt(5)) / 2
    pos = [[a, b, 0] for a in (-1, 1) for b in (-golden, golden)]
    points = np.array(pos + [[0, *p[:2]] for p in pos] + [[p[1], 0, p[0]] for p in pos], dtype=np.float64)
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 2.1
    faces = np.array([(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] * near[j, k] * near[k, i]])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for _ in range(subdivisions):
        points, faces = _subdivide(points, faces)
    corners = points[faces]
    inward = np.einsum("fi,fi->f", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners[:, 0]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return radius * points, faces


def box(cells: int = 4, size: float = 1.0) -> Mesh:
    """Cube of side ``size`` about the origin, ``cells`` × ``cells`` quads per side; outward normals."""
    sheet, faces = grid(cells + 1, cells + 1, size)
    sheet = sheet + np.array([-0.5, 0.5, -0.5]) * size
    half = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]])
    quarter = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])
    other = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    turns = [np.eye(3), half, quarter, quarter.T, other, other.T]
    pos = np.concatenate([sheet @ turn.T for turn in turns])
    tri = np.concatenate([faces + i * len(sheet) for i in range(6)])
    _, first, inverse = np.unique(np.round(pos / size * 4 * cells), axis=0, return_index=True, return_inverse=True)
    return pos[first], inverse.reshape(-1)[tri]


def _split_quads(i: np.ndarray, j: np.ndarray, columns: int, count: int) -> np.ndarray:
    """Two triangles per cell (i, j) of a row-major vertex table; diagonals alternate, columns wrap."""
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    even = ((i + j) % 2 == 0)[:, None, None]
    first = np.stack([np.stack([a, b, c], 1), np.stack([b, d, c], 1)], axis=1)
    second = np.stack([np.stack([a, b, d], 1), np.stack([a, d, c], 1)], axis=1)
    faces = np.where(even, first, second).reshape(-1, 3).astype(np.int64)
    assert faces.max() < count
    return faces


def _subdivide(pos: np.ndarray, faces: np.ndarray) -> Mesh:
    """Split every face in four and project the new vertices onto the unit sphere."""
    pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    middle = pos[edges].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    ab, bc, ca = (inverse.reshape(-1, 3) + len(pos)).T
    a, b, c = faces.T
    tables = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([pos, middle]), np.concatenate([np.stack(table, axis=1) for table in tables])
