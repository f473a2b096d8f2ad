"""Checks that refuse meshes which cannot be simulated; the error names the element and the repair."""

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
