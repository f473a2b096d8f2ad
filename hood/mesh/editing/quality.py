"""Checks that refuse meshes which cannot be simulated; the error names the element and the repair.

Polygons into triangles: any number of corners, convex or not, planar or nearly so.
"""

from __future__ import annotations

import numpy as np

#: A face counts as zero-area when its area is below this fraction of its longest edge squared.
ZERO_AREA_RATIO = 1e-10
#: No coordinate of a garment or body is farther from zero, in any unit: beyond it areas and volumes overflow.
FARTHEST = 1e9


def check_triangles(pos: np.ndarray, faces: np.ndarray, name: str) -> None:
    """Check a triangle mesh; return silently when it can be simulated.

    Isolated vertices, edges with three or more faces, inconsistent winding and several components are legal.

    Args:
        pos: (V, 3) m.
        faces: (F, 3) integer vertex indices.
        name: what the message calls the mesh, such as ``"garment 'dress'"`` or a file path.

    Raises:
        ValueError: naming the mesh, the index and the fix: empty mesh, wrong shape, quads or polygons, non-integer or
            out-of-range indices, a vertex repeated within a face, duplicate faces, NaN or infinite positions, zero area.
    """
    pos, faces = np.asarray(pos), np.asarray(faces)
    _check_shapes(pos, faces, name)
    _check_indices(len(pos), faces, name)
    bad = ~np.isfinite(pos).all(axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise ValueError(f"{name}: vertex {index} is {pos[index].tolist()}; positions must be finite, fix or remove it")
    far = far_vertex(pos)
    if far is not None:
        raise ValueError(f"{name}: {far}")
    _check_areas(pos.astype(np.float64), faces, name)


def far_vertex(pos: np.ndarray) -> str | None:
    """The sentence about the first vertex of ``pos`` (V, 3) beyond any unit; None where there is none. NaN is not looked at."""
    far = (np.abs(pos) > FARTHEST).any(axis=1)
    if not far.any():
        return None
    index = int(np.argmax(far))
    return f"vertex {index} is {pos[index].tolist()}; no unit has coordinates beyond ±{FARTHEST:g}, fix or remove it"


def _check_shapes(pos: np.ndarray, faces: np.ndarray, name: str) -> None:
    if len(pos) == 0 or faces.size == 0:
        raise ValueError(f"{name}: the mesh is empty ({len(pos)} vertices, {len(faces)} faces); give at least one triangle")
    if pos.ndim != 2 or pos.shape[1] != 3:
        raise ValueError(f"{name}: positions have shape {pos.shape}; give (num_vertices, 3)")
    if faces.dtype == object or faces.ndim != 2:
        raise ValueError(f"{name}: faces have different numbers of corners; split polygons into triangles first")
    if faces.shape[1] != 3:
        raise ValueError(
            f"{name}: faces have {faces.shape[1]} corners each; split them into triangles first "
            "(a quad 0-1-2-3 becomes 0-1-2 and 0-2-3)"
        )


def _check_indices(num_vertices: int, faces: np.ndarray, name: str) -> None:
    if not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"{name}: face indices are {faces.dtype}; give integers")
    bad = ((faces < 0) | (faces >= num_vertices)).any(axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise ValueError(
            f"{name}: face {index} refers to vertices {faces[index].tolist()} but the mesh has "
            f"{num_vertices}; indices must be from 0 to {num_vertices - 1}"
        )
    ordered = np.sort(faces, axis=1)
    bad = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise ValueError(f"{name}: face {index} repeats a vertex ({faces[index].tolist()}); remove the face")
    _, first, inverse = np.unique(ordered, axis=0, return_index=True, return_inverse=True)
    bad = first[inverse.reshape(-1)] != np.arange(len(faces))
    if bad.any():
        index = int(np.argmax(bad))
        twin = int(first[inverse.reshape(-1)[index]])
        raise ValueError(f"{name}: face {index} duplicates face {twin} ({faces[index].tolist()}); remove one of them")


def _check_areas(pos: np.ndarray, faces: np.ndarray, name: str) -> None:
    corners = pos[faces]
    e1, e2, e3 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], corners[:, 2] - corners[:, 1]
    area = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
    longest_sq = np.max([(e * e).sum(axis=1) for e in (e1, e2, e3)], axis=0)
    bad = area <= ZERO_AREA_RATIO * longest_sq
    if bad.any():
        index = int(np.argmax(bad))
        raise ValueError(
            f"{name}: face {index} has zero rest area (vertices {faces[index].tolist()}); "
            "merge coincident vertices and remove the face"
        )


#: Polygons beyond this many corners are refused by the readers: clipping ears takes the cube of the number at worst.
MAX_CORNERS = 1000


def triangulate(pos: np.ndarray, corners: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) as rows of the flat table ``corners``, so that any per-corner index can follow.

    A polygon of n corners gives n - 2 triangles of the same winding, in the polygons' order. A quad is cut along its shorter
    diagonal if both halves then face the quad's side, else along the other; larger polygons lose the ear with the
    shortest diagonal until a triangle is left. Triangles pass unchanged. Polygons that cross themselves give
    triangles that overlap.

    Args:
        pos: (V, 3).
        corners: (N,) vertex of every corner, polygon after polygon.
        counts: (P,) corners of each polygon, each from 3 to :data:`MAX_CORNERS`.
    """
    starts = np.cumsum(counts) - counts
    first_row = np.cumsum(counts - 2) - (counts - 2)
    triangles = np.empty((int((counts - 2).sum()), 3), dtype=np.int64)
    three = counts == 3
    triangles[first_row[three]] = starts[three, None] + np.arange(3)
    four = np.flatnonzero(counts == 4)
    if len(four):
        halves = _cut_quads(pos[corners[starts[four, None] + np.arange(4)]])
        triangles[first_row[four]] = starts[four, None] + halves[:, 0]
        triangles[first_row[four] + 1] = starts[four, None] + halves[:, 1]
    for polygon in np.flatnonzero(counts > 4):
        start, count, row = starts[polygon], counts[polygon], first_row[polygon]
        triangles[row : row + count - 2] = start + _clip_ears(pos[corners[start : start + count]])
    return triangles


def newell_normal(points: np.ndarray) -> np.ndarray:
    """Normal (..., 3) of closed polygons (..., n, 3), its length twice the area; robust for corners out of plane."""
    centred = points - points.mean(axis=-2, keepdims=True)
    return np.cross(centred, np.roll(centred, -1, axis=-2)).sum(axis=-2)


def _cut_quads(points: np.ndarray) -> np.ndarray:
    """Two triangles (Q, 2, 3), as corner numbers 0…3, of quads (Q, 4, 3)."""
    options = np.array([[[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]])
    normal = newell_normal(points)
    length = np.stack(
        [np.linalg.norm(points[:, 2] - points[:, 0], axis=1), np.linalg.norm(points[:, 3] - points[:, 1], axis=1)]
    )
    facing = np.empty((2, len(points)))
    for option, halves in enumerate(options):
        corner = points[:, halves]  # (Q, 2, 3, 3)
        cross = np.cross(corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0])
        facing[option] = np.einsum("qhi,qi->qh", cross, normal).min(axis=1)
    second = np.where((facing[0] > 0) == (facing[1] > 0), length[1] < length[0], facing[1] > facing[0])
    return options[second.astype(np.int64)]


def _clip_ears(points: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3), as corner numbers, of one polygon (n, 3)."""
    flat = _project(points)
    left = list(range(len(points)))
    triangles = []
    while len(left) > 3:
        index = _best_ear(flat[left])
        triangles.append([left[index - 1], left[index], left[(index + 1) % len(left)]])
        del left[index]
    return np.array([*triangles, left])


def _project(points: np.ndarray) -> np.ndarray:
    """The polygon (n, 2) in its own plane, counter-clockwise."""
    normal = newell_normal(points)
    size = np.linalg.norm(normal)
    normal = normal / size if size > 0 else np.array([0.0, 0.0, 1.0])
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    return np.stack([points @ x, points @ np.cross(normal, x)], axis=1)


def _best_ear(flat: np.ndarray) -> int:
    """The corner of the polygon (n, 2) whose removal cuts off an empty convex triangle by the shortest diagonal."""
    before, after = np.roll(flat, 1, axis=0), np.roll(flat, -1, axis=0)
    diagonal = np.linalg.norm(after - before, axis=1)
    convex = _cross(flat - before, after - flat) > 0
    reflex = flat[~convex]
    for index in np.argsort(diagonal, kind="stable"):
        if convex[index] and not _any_inside(reflex, before[index], flat[index], after[index]):
            return int(index)
    return int(np.argmin(np.where(convex, diagonal, np.inf))) if convex.any() else int(np.argmin(diagonal))


def _any_inside(points: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> bool:
    """Whether one of ``points`` (n, 2) lies in the counter-clockwise triangle; its own corners do not count."""
    own = (points == a).all(axis=1) | (points == b).all(axis=1) | (points == c).all(axis=1)
    inside = (_cross(b - a, points - a) >= 0) & (_cross(c - b, points - b) >= 0) & (_cross(a - c, points - c) >= 0)
    return bool((inside & ~own).any())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
