"""Open edges cut by new vertices: the faces behind them become fans, and everything that corners carry is divided alike."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Cut(NamedTuple):
    """A mesh with new vertices on open edges."""

    faces: np.ndarray  # (F′, 3), the uncut faces first
    parent: np.ndarray  # (F′,) the face that each is of
    corners: np.ndarray  # (F′, 3) rows of ``sources``: where each corner of the new faces comes from
    sources: np.ndarray  # (S, 2) corners of the old faces, as face · 3 + corner; twice the same for one that was there
    at: np.ndarray  # (S,) 0 to 1, from the first to the second
    ends: np.ndarray  # (N, 2) vertices that each new vertex lies between, in the order of the cuts
    share: np.ndarray  # (N,) 0 to 1, from the first to the second


def cut_edges(faces: np.ndarray, num_vertices: int, face: np.ndarray, corner: np.ndarray, at: np.ndarray) -> Cut:
    """``faces`` (F, 3) with the vertex ``num_vertices`` + n on the edge of ``face[n]`` from its ``corner[n]`` on, at the
    share ``at[n]`` of it. No two faces share one of these edges."""
    following = (corner + 1) % 3
    ends = np.stack([faces[face, corner], faces[face, following]], axis=1)
    old = np.arange(faces.size)
    sources = np.concatenate([np.stack([old, old], axis=1), np.stack([3 * face + corner, 3 * face + following], axis=1)])
    shares = np.concatenate([np.zeros(faces.size), at])
    whole = np.setdiff1d(np.arange(len(faces)), face)
    tables, parents = [old.reshape(-1, 3)[whole]], [whole]
    for one in np.unique(face).tolist():
        fan = _fan(one, [np.flatnonzero((face == one) & (corner == k)) for k in range(3)], at, faces.size)
        tables.append(fan)
        parents.append(np.full(len(fan), one))
    corners = np.concatenate(tables)
    vertex = np.concatenate([faces.reshape(-1), num_vertices + np.arange(len(face))])
    return Cut(vertex[corners], np.concatenate(parents), corners, sources, shares, ends, at)


def _fan(face: int, on_edges: list[np.ndarray], at: np.ndarray, count: int) -> np.ndarray:
    """Triangles (n, 3) of sources that a face with vertices on its edges is cut into: a polygon whose ears are cut off where
    they are no slivers."""
    polygon: list[int] = []
    side: list[set[int]] = []
    for k, rows in enumerate(on_edges):
        polygon.append(3 * face + k)
        side.append({k, (k - 1) % 3})
        for row in rows[np.argsort(at[rows])]:
            polygon.append(count + int(row))
            side.append({k})
    triangles = []
    while len(polygon) > 3:
        ear = next(n for n in range(len(polygon)) if _is_ear(side, n))
        triangles.append([polygon[ear - 1], polygon[ear], polygon[(ear + 1) % len(polygon)]])
        del polygon[ear], side[ear]
    return np.array([*triangles, polygon], dtype=np.int64)


def _is_ear(side: list[set[int]], n: int) -> bool:
    """Whether a corner of a polygon and its neighbours lie on no one side of the triangle, nor what is left without it."""
    return not (side[n - 1] & side[n] & side[(n + 1) % len(side)] or set.intersection(*side[:n], *side[n + 1 :]))


def along(cut: Cut, values: np.ndarray) -> np.ndarray:
    """Values (V, …) of vertices with those of the new ones behind them, linear along their edges."""
    share = cut.share.reshape(-1, *[1] * (values.ndim - 1))
    new = (1.0 - share) * values[cut.ends[:, 0]] + share * values[cut.ends[:, 1]]
    return np.concatenate([values, new.astype(values.dtype)])


def along_corners(cut: Cut, table: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (F′, 3) into values (U′, n), from corners (F, 3) into values (U, n): such as texture coordinates."""
    flat, added = table.reshape(-1), len(cut.sources) - table.size
    first, second = flat[cut.sources[table.size :]].T
    share = cut.at[table.size :, None]
    number = np.concatenate([flat, len(values) + np.arange(added)])
    return number[cut.corners], np.concatenate([values, (1.0 - share) * values[first] + share * values[second]])
