"""Counts beside the pictures, by code that shares nothing with the library: vertices in the body, crossing pairs, stretch."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

Array = np.ndarray


def inside(points: Array, pos: Array, faces: Array) -> Array:
    """Which points (N, 3) lie in a closed surface: its winding number, from solid angles (van Oosterom and Strackee, 1983)."""
    corners = pos[faces]
    found = np.zeros(len(points))
    maybe = _behind(points, pos, faces)
    for first in range(0, len(maybe), 64):
        some = maybe[first : first + 64]
        a, b, c = (corners[None, :, corner] - points[some, None] for corner in range(3))
        la, lb, lc = (np.linalg.norm(edge, axis=2) for edge in (a, b, c))
        above = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
        below = la * lb * lc + np.einsum("nfi,nfi->nf", a, b) * lc
        below += np.einsum("nfi,nfi->nf", b, c) * la + np.einsum("nfi,nfi->nf", c, a) * lb
        found[some] = np.arctan2(above, below).sum(axis=1) / (2 * np.pi)
    return found > 0.5


def crossings(pos: Array, faces: Array, other_pos: Array | None = None, other_faces: Array | None = None) -> Array:
    """Pairs (P, 2) of triangles of which an edge of one passes through the other; of one mesh, or of two."""
    alone = other_pos is None
    first = pos[faces]
    second = first if other_pos is None or other_faces is None else other_pos[other_faces]
    pairs = _boxes(first, second)
    if alone:
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        shared = (faces[pairs[:, 0], :, None] == faces[pairs[:, 1], None, :]).any(axis=(1, 2))
        pairs = pairs[~shared]
    a, b = first[pairs[:, 0]], second[pairs[:, 1]]
    return pairs[_pierced(a, b) | _pierced(b, a)]


def stretch(pos: Array, rest: Array, faces: Array) -> Array:
    """Length over rest length of every edge (E,)."""
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    long = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    return np.asarray(long / np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1))


def parts(count: int, faces: Array) -> Array:
    """Number (V,) of the connected part of every vertex."""
    own = np.arange(count)
    while True:
        least = own[faces].min(axis=1)
        lower = own.copy()
        np.minimum.at(lower, faces, least[:, None])
        lower = lower[lower]
        if np.array_equal(lower, own):
            return np.unique(own, return_inverse=True)[1]
        own = lower


def _behind(points: Array, pos: Array, faces: Array) -> Array:
    """Rows of the points that do not lie clearly ahead of the three vertices nearest to them."""
    normal = np.zeros_like(pos)
    corners = pos[faces]
    for corner in range(3):
        np.add.at(normal, faces[:, corner], np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    _, near = cKDTree(pos).query(points, 3)
    ahead = np.einsum("nki,nki->nk", points[:, None] - pos[near], normal[near])
    return np.flatnonzero(ahead.min(axis=1) < 2e-3)


def _boxes(first: Array, second: Array) -> Array:
    """Pairs whose boxes overlap."""
    low, high = second.min(axis=1), second.max(axis=1)
    order = np.argsort(low[:, 0])
    starts = low[order, 0]
    widest = float((high[:, 0] - low[:, 0]).max())
    found = []
    for row, triangle in enumerate(first):
        least, most = triangle.min(axis=0), triangle.max(axis=0)
        near = order[np.searchsorted(starts, least[0] - widest) : np.searchsorted(starts, most[0], side="right")]
        near = near[((low[near] <= most) & (high[near] >= least)).all(axis=1)]
        found.append(np.stack([np.full(len(near), row), near], axis=1))
    return np.concatenate(found)


def _pierced(edges_of: Array, by: Array) -> Array:
    """Where an edge of the first triangles (P, 3, 3) passes through the second ones."""
    origin, u, v = by[:, 0], by[:, 1] - by[:, 0], by[:, 2] - by[:, 0]
    normal = np.cross(u, v)
    found = np.zeros(len(by), dtype=bool)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        a, way = edges_of[:, start], edges_of[:, end] - edges_of[:, start]
        along = np.einsum("pi,pi->p", normal, way)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.einsum("pi,pi->p", normal, origin - a) / along
            hit = a + t[:, None] * way - origin
            area = np.einsum("pi,pi->p", normal, normal)
            s = np.einsum("pi,pi->p", np.cross(hit, v), normal) / area
            r = np.einsum("pi,pi->p", np.cross(u, hit), normal) / area
        found |= (t > 0) & (t < 1) & (s > 0) & (r > 0) & (s + r < 1)
    return found
