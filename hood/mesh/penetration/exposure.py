"""How far a closed surface (skin) sticks out through a sheet that should lie outside it (cloth)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hood.mesh import topology
from hood.mesh.penetration.boxes import overlapping_boxes
from hood.mesh.penetration.compiled import Eights, depth, eights
from hood.mesh.penetration.crossing import Crossings

#: Skin farther than this [m] from all cloth is bare.
EXPOSURE_REACH = 0.1
_BEHIND = 0.5  # cosine of 60 degrees
_NEAREST = 0.8


class Sheet(NamedTuple):
    """What of a cloth with faces (F, 3) depends on these alone."""

    edges: np.ndarray  # (E, 2) as of hood.mesh.topology.unique_edges
    open_edge: np.ndarray  # (F, 3) bool: the edge from this corner to the next belongs to this face alone
    on_rim: np.ndarray  # (V,) bool, ends of such edges

    @classmethod
    def of(cls, faces: np.ndarray) -> Sheet:
        """That of faces (F, 3)."""
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, row, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        on_rim = np.zeros(int(faces.max(initial=-1)) + 1, dtype=bool)
        on_rim[unique[count == 1]] = True
        return cls(unique, (count[row.reshape(-1)] == 1).reshape(-1, 3), on_rim)


def skin_depth(
    pos: np.ndarray,
    faces: np.ndarray,
    skin_pos: np.ndarray,
    skin_faces: np.ndarray,
    cut: Crossings,
    sheet: Sheet | None = None,
    both: tuple[Eights, Eights] | None = None,
) -> float:
    """Largest height [m] of a vertex of the skin above the cloth; 0 where none is above it.

    A vertex of the skin (W, 3) is **above** the cloth (V, 3) if the cloth's point nearest to it

    - belongs to a face that the skin cuts, or to one whose corners are all under the skin (:func:`sunken`);
    - is not on the rim of the cloth: skin beside a hem is bare, it does not stick out through anything;
    - lies behind the skin, within 60 degrees of straight inwards: in the bend of a knee the skin looks along the cloth;
    - is not under another part of the skin: no vertex of the skin is nearer to it than 0.8 times as far, as the back of a hand
      is farther from cloth that cuts the palm;
    - and is no farther away than :data:`EXPOSURE_REACH`.

    Its height is the distance to that point. It is taken at vertices: of a skin that is coarser than the cloth it is too small.

    Args:
        skin_faces: wound so that normals point outwards; the winding of the cloth plays no role.
        cut: the crossings of the cloth with the skin, all positions finite.
        sheet: of ``faces``, where it is known.
        both: :func:`hood.mesh.penetration.compiled.eights` of ``faces`` and ``skin_faces``, where they are known.
    """
    if not len(cut.pairs):
        return 0.0
    sheet = Sheet.of(faces) if sheet is None else sheet
    cloth, skin = both or (eights(faces, pos), eights(skin_faces, skin_pos))
    if cloth is not None and skin is not None:
        return depth(cloth, pos, skin, skin_pos, sheet, cut[:2], (EXPOSURE_REACH, _BEHIND, _NEAREST))
    suspect = np.zeros(len(faces), dtype=bool)
    suspect[cut.pairs[:, 0]] = True
    suspect |= sunken(pos, sheet.edges, skin_pos, skin_faces, cut)[faces].all(axis=1)
    corners = pos[faces]
    reached = corners[suspect].reshape(-1, 3)
    low, high = reached.min(axis=0) - EXPOSURE_REACH, reached.max(axis=0) + EXPOSURE_REACH
    close = np.flatnonzero(((skin_pos >= low) & (skin_pos <= high)).all(axis=1))
    nearest = _nearest(skin_pos[close], np.full(len(close), EXPOSURE_REACH), corners, np.flatnonzero(suspect))
    if nearest is None:
        return 0.0
    which, face, weights, point, dist = nearest
    vertex = close[which]
    normal = _normals(skin_pos, skin_faces, vertex)
    inwards = -np.einsum("ni,ni->n", point - skin_pos[vertex], normal)
    behind = inwards > _BEHIND * dist * np.linalg.norm(normal, axis=1)
    kept = np.flatnonzero(behind & ~_on_rim(sheet, faces[face], face, weights))
    if len(kept) == 0:
        return 0.0
    kept = kept[_clearance(point[kept], skin_pos) >= _NEAREST * dist[kept]]
    # Where another face is nearer still, the vertex is under cloth that is not cut.
    other = _nearest(skin_pos[vertex[kept]], dist[kept], corners, np.flatnonzero(~suspect))
    if other is not None:
        nearer = other[4] < dist[kept][other[0]] * (1 - 1e-9)
        kept = np.delete(kept, other[0][nearer])
    return float(dist[kept].max(initial=0.0))


def sunken(pos: np.ndarray, edges: np.ndarray, skin_pos: np.ndarray, skin_faces: np.ndarray, cut: Crossings) -> np.ndarray:
    """Which vertices of the cloth, with unique ``edges`` (E, 2), are under the skin, (V,) bool.

    An edge that the skin cuts says on which side its ends are, by the plane of the skin's face nearest to each; one that it
    does not cut has both ends on the same side. So the parts of the cloth between cut edges are on one side each; where skin
    passes through itself the majority of the ends decides. Parts without a cut edge count as outside.
    """
    start, end, through = cut.first_edges.T
    whole = np.ones(len(edges), dtype=bool)
    whole[topology.edge_index(edges, cut.first_edges[:, :2])] = False
    part = topology.connected_components(len(pos), edges[whole])
    corner = skin_pos[skin_faces[through]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    heights = [np.einsum("ni,ni->n", pos[vertex] - corner[:, 0], normal) for vertex in (start, end)]
    along = heights[0] / (heights[0] - heights[1])  # the ends are on two sides of the plane
    votes = np.zeros(len(pos))
    row = np.column_stack([start, end])
    for vertex, height, order in ((start, heights[0], along), (end, heights[1], -along)):
        first = np.lexsort((order, row[:, 1], row[:, 0]))
        first = first[np.r_[True, (row[first][1:] != row[first][:-1]).any(axis=1)][: len(first)]]
        np.add.at(votes, part[vertex[first]], np.sign(height[first]))
    return votes[part] < 0


def closest_on_triangles(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points (N, 3) of triangles (N, 3, 3) to points (N, 3), and their barycentric weights (N, 3).

    Weights are exactly 0 for corners that have no part in it: on an edge one, at a corner two. Also of triangles without area.
    """
    best = np.full(len(points), np.inf)
    weights = np.zeros((len(points), 3))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, j] - corners[:, i]
        length_sq = np.einsum("ni,ni->n", along, along)
        share = np.einsum("ni,ni->n", points - corners[:, i], along) / np.where(length_sq > 0, length_sq, 1.0)
        share = np.clip(share, 0.0, 1.0)
        offset = points - corners[:, i] - share[:, None] * along
        dist_sq = np.einsum("ni,ni->n", offset, offset)
        better = dist_sq < best
        best = np.where(better, dist_sq, best)
        edge = np.zeros_like(weights)
        edge[:, i], edge[:, j] = 1.0 - share, share
        weights = np.where(better[:, None], edge, weights)
    inside = _interior_weights(points, corners)
    weights = np.where(inside.min(axis=1, keepdims=True) > 0, inside, weights)
    return np.einsum("ni,nij->nj", weights, corners), weights


def _interior_weights(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric weights (N, 3) of the feet of perpendiculars to the planes; -1 of triangles without area."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = points - corners[:, 0]
    normal = np.cross(first, second)
    area_sq = np.einsum("ni,ni->n", normal, normal)
    flat = area_sq <= (16 * np.finfo(float).eps) ** 2 * np.einsum("ni,ni->n", first, first) * np.einsum(
        "ni,ni->n", second, second
    )
    scale = 1.0 / np.where(flat, 1.0, area_sq)
    b = np.einsum("ni,ni->n", np.cross(offset, second), normal) * scale
    c = np.einsum("ni,ni->n", np.cross(first, offset), normal) * scale
    return np.where(flat[:, None], -1.0, np.column_stack([1.0 - b - c, b, c]))


def _clearance(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distances (N,) from points (N, 3) to the nearest of others (M, 3)."""
    return np.asarray(cKDTree(others).query(points)[0])


def _nearest(
    points: np.ndarray, reach: np.ndarray, corners: np.ndarray, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Of points (N, 3) with one of the ``chosen`` triangles within their ``reach`` (N,): their numbers, the nearest triangle,
    weights, nearest point and distance; None where there is none."""
    # Some corner is this near; so is the nearest point.
    known, _ = cKDTree(corners[chosen].reshape(-1, 3)).query(points)
    reach = np.minimum(known, reach)
    triangles = corners[chosen]
    around = reach[:, None] * (1 + 1e-9)
    parts = []
    for pairs in overlapping_boxes(triangles.min(axis=1), triangles.max(axis=1), points - around, points + around):
        face, row = pairs.T
        point, weights = closest_on_triangles(points[row], triangles[face])
        dist = np.linalg.norm(points[row] - point, axis=1)
        kept = dist <= reach[row] * (1 + 1e-9)
        parts.append([values[kept] for values in (row, chosen[face], weights, point, dist)])
    if not parts:
        return None
    row, face, weights, point, dist = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((face, dist, row))
    order = order[np.r_[True, row[order][1:] != row[order][:-1]][: len(order)]]
    return row[order], face[order], weights[order], point[order], dist[order]


def _on_rim(sheet: Sheet, corners: np.ndarray, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Which points, given by the numbers of a face's ``corners`` (N, 3), the face (N,) and weights, lie on an edge that belongs
    to one face alone, (N,) bool."""
    away = weights == 0.0
    on_edge = (away[:, [2, 0, 1]] & sheet.open_edge[face]).any(axis=1)
    return on_edge | ((away.sum(axis=1) == 2) & (~away & sheet.on_rim[corners]).any(axis=1))


def _normals(pos: np.ndarray, faces: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Area-weighted normals (N, 3) at some vertices, not of unit length."""
    wanted = np.zeros(len(pos), dtype=bool)
    wanted[vertices] = True
    faces = faces[wanted[faces].any(axis=1)]
    a, b, c = (pos[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    columns = [np.bincount(faces.reshape(-1), np.repeat(normal[:, axis], 3), minlength=len(pos)) for axis in range(3)]
    return np.stack(columns, axis=1)[vertices]
