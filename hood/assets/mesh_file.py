"""Mesh files as the user wrote them: same vertices, same faces, same order; what readers change silently is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

#: Formats that keep a corner of every face or every texture seam as a vertex of its own: equal positions are one vertex.
_SPLIT_FORMATS = (".stl", ".glb")
MESH_SUFFIXES = (".obj", ".ply", ".off", *_SPLIT_FORMATS)


def read_mesh(path: Path, triangulate: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 [m] and triangles (F, 3) int64 of a mesh file.

    Args:
        triangulate: split faces of four and more corners instead of refusing them.

    Raises:
        ValueError: unreadable file, polygons, or an index out of range; names the file, the face and the fix.
    """
    if path.suffix.lower() == ".obj":
        return _read_obj(path, triangulate)
    import trimesh

    try:
        mesh: Any = trimesh.load(path, process=False, maintain_order=True, force="mesh")
        pos, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else repr(error)
        raise ValueError(f"{path}: not a readable mesh ({reason})") from error
    declared = _declared_faces(path)
    if not triangulate and declared is not None and declared < len(faces):
        raise ValueError(
            f"{path}: {declared} faces are {len(faces)} triangles, some have more than three corners; triangulate "
            "them or pass triangulate=true"
        )
    return _merge(pos, faces) if path.suffix.lower() in _SPLIT_FORMATS else (pos, faces)


def _read_obj(path: Path, triangulate: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions and faces alone: general readers duplicate vertices along material borders, which tears a garment."""
    pos: list[list[float]] = []
    polygons: list[list[int]] = []
    with open(path, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = line.split("#")[0].split()
            try:
                if words[:1] == ["v"]:
                    pos.append([float(word) for word in words[1:4]])
                elif words[:1] == ["f"]:
                    corners = [int(word.split("/")[0]) for word in words[1:]]
                    # Negative indices count back from the last vertex so far; 0 does not exist in the format.
                    polygons.append([len(pos) + c if c < 0 else c - 1 for c in corners])
            except ValueError:
                raise ValueError(f"{path}: line {number} is not readable ({line.strip()[:60]!r})") from None
    if any(len(row) != 3 for row in pos):
        index = next(i for i, row in enumerate(pos) if len(row) != 3)
        raise ValueError(f"{path}: vertex {index} has {len(pos[index])} coordinates; give three")
    return np.array(pos, dtype=np.float64).reshape(-1, 3), _triangles(path, polygons, len(pos), triangulate)


def _triangles(path: Path, polygons: list[list[int]], num_vertices: int, triangulate: bool) -> np.ndarray:
    triangles = []
    for face, corners in enumerate(polygons):
        if len(corners) < 3 or (len(corners) > 3 and not triangulate):
            raise ValueError(f"{path}: face {face} has {len(corners)} corners; triangulate it or pass triangulate=true")
        for corner in corners:
            if not 0 <= corner < num_vertices:
                raise ValueError(
                    f"{path}: face {face} refers to vertex {corner + 1} of {num_vertices}; repair or remove the face"
                )
        triangles += [[corners[0], corners[k], corners[k + 1]] for k in range(1, len(corners) - 1)]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _declared_faces(path: Path) -> int | None:
    """Number of faces that the head of a PLY or OFF file announces; None for other formats."""
    with open(path, "rb") as file:
        head = file.read(4096).decode("latin-1")
    if path.suffix.lower() == ".ply":
        match = re.search(r"^element\s+face\s+(\d+)", head, re.M)
    elif path.suffix.lower() == ".off":
        match = re.match(r"OFF\s+(?:#[^\n]*\n\s*)*\d+\s+(\d+)", head)
    else:
        return None
    return int(match.group(1)) if match else None


def _merge(pos: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at equal positions become one, in the order of first appearance."""
    _, first, inverse = np.unique(pos, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.argsort(order)
    return pos[first[order]], rank[inverse.reshape(-1)][faces]
