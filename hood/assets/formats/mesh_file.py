"""Mesh files as the user wrote them: same vertices, same faces, same order; what cannot be kept is refused or reported.

One object of a mesh file, by a name behind the file's: ``scene.obj:Avatar``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hood import plugins
from hood.assets.files.guarded import check_size, guarded, listed
from hood.assets.files.text import meant
from hood.assets.formats.gltf import read_glb
from hood.assets.formats.obj_off_stl import read_obj, read_off, read_stl
from hood.assets.formats.ply import read_ply
from hood.assets.formats.raw_mesh import RawMesh, Unreadable
from hood.assets.formats.usd import USD_SUFFIXES, read_usd
from hood.mesh.editing.quality import MAX_CORNERS, far_vertex, triangulate
from hood.mesh.parts import part_labels

_READERS: dict[str, Callable[[Path], RawMesh]] = {
    ".obj": read_obj,
    ".ply": read_ply,
    ".off": read_off,
    ".stl": read_stl,
    ".glb": read_glb,
    ".gltf": read_glb,
    **dict.fromkeys(USD_SUFFIXES, read_usd),
}
#: Formats that keep a corner of every face or every texture seam as a vertex of its own: equal positions are one vertex.
_SPLIT_FORMATS = (".stl", ".glb", ".gltf")
MESH_SUFFIXES = tuple(_READERS)
#: Their readers, see :mod:`hood.plugins`: a path in; vertices (V, 3) [m] and triangles (F, 3) out, or a :class:`RawMesh`.
_PLUGINS = "meshes"
#: Files beyond this size [bytes] are not opened.
MESH_SIZE_LIMIT = 1 << 30


@dataclass(frozen=True)
class MeshFile:
    """A mesh file as triangles. Texture seams and hard edges do not tear it: their tables stand apart."""

    pos: np.ndarray  # (V, 3) float64, in the file's units
    faces: np.ndarray  # (F, 3) int64
    uv: np.ndarray | None = None  # (U, 2), v up
    uv_faces: np.ndarray | None = None  # (F, 3) into uv
    normal_faces: np.ndarray | None = None  # (F, 3): corners of one number share a normal; None: smooth everywhere
    colours: np.ndarray | None = None  # (V, 3), 0 to 1
    panels: dict[str, np.ndarray] | None = None  # (F,) bool each: the triangles of an object, group or material, by its name
    stitches: np.ndarray | None = None  # (S, 2) vertices that lines of the file join
    num_polygons: int = 0  # faces of four and more corners that were split
    num_joined: int = 0  # vertices that the format had doubled
    notes: tuple[str, ...] = ()  # what was not kept
    corners: np.ndarray | None = None  # (N,) vertex of every corner, polygon after polygon, before any was split
    counts: np.ndarray | None = None  # (P,) corners of every polygon


def mesh_suffixes() -> tuple[str, ...]:
    """Suffixes of the mesh files that can be read, those of plugins last."""
    return (*MESH_SUFFIXES, *(f".{name}" for name in plugins.names(_PLUGINS)))


def read_mesh(path: Path, triangulate: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 [m] and triangles (F, 3) int64 of a mesh file; arguments and errors of :func:`read_mesh_file`."""
    mesh = read_mesh_file(path, triangulate)
    return mesh.pos, mesh.faces


def read_mesh_file(path: Path, split_polygons: bool = False) -> MeshFile:
    """A mesh file (OBJ, PLY, OFF, STL, GLB, USD, and the formats of plugins).

    Args:
        split_polygons: split faces of four and more corners (:func:`hood.mesh.editing.quality.triangulate`) instead of
            refusing them.

    Raises:
        FileNotFoundError: no such file.
        ValueError: unreadable file, polygons, or an index out of range; names the file, the face and the fix.
    """
    suffix = path.suffix.lower()
    if suffix not in mesh_suffixes():
        raise ValueError(f"{path}: unknown mesh format {suffix!r}; give {', '.join(mesh_suffixes())}")
    read_raw = _READERS.get(suffix) or partial(_read_by_plugin, plugins.find(_PLUGINS, suffix[1:]))
    check_size(path, MESH_SIZE_LIMIT)

    def read() -> MeshFile | ValueError:
        try:
            return _finish(read_raw(path), split_polygons, suffix in _SPLIT_FORMATS)
        except Unreadable as error:
            return ValueError(f"{path}: {error}")
        except ValueError as error:
            if str(error).startswith(f"{path}: "):
                return error
            raise

    result = guarded(path, f"{suffix[1:].upper()} mesh", read)
    if isinstance(result, ValueError):
        raise result
    assert isinstance(result, MeshFile)
    return result


def _read_by_plugin(read: Callable[[Path], Any], path: Path) -> RawMesh:
    """What a plugin's reader gives, in the types of ours.

    Raises:
        Unreadable: the reader refuses the file, or gives no mesh.
    """
    try:
        found = read(path)
        if isinstance(found, RawMesh):
            return found
        pos, faces = (np.asarray(table) for table in found)
    except OSError:
        raise
    except (TypeError, ValueError) as error:
        raise Unreadable(f"the reader of {path.suffix} files: {error}") from error
    sound = pos.ndim == faces.ndim == 2 and pos.shape[1] == faces.shape[1] == 3 and faces.dtype.kind in "iu"
    if not sound or pos.dtype.kind not in "iuf":
        raise Unreadable(
            f"the reader of {path.suffix} files gives tables {pos.shape} {pos.dtype} and {faces.shape} {faces.dtype}; it has "
            "to return vertices (V, 3) and triangles (F, 3) of whole numbers"
        )
    return RawMesh(pos.astype(np.float64), faces.astype(np.int64).reshape(-1), np.full(len(faces), 3, dtype=np.int64))


def _finish(raw: RawMesh, split_polygons: bool, join: bool) -> MeshFile:
    _check(raw, split_polygons)
    rows = triangulate(raw.pos, raw.corners, raw.counts)
    vertex_map, kept = _equal_positions(raw.pos) if join else (np.arange(len(raw.pos)), np.arange(len(raw.pos)))
    notes = list(raw.notes)
    uv_faces = _corner_table(raw.uv_corners, len(raw.uv) if raw.uv is not None else 0, rows, "texture coordinate", notes)
    faces = vertex_map[raw.corners][rows]
    polygon = np.repeat(np.arange(len(raw.counts)), raw.counts)[rows[:, 0]]
    return MeshFile(
        pos=raw.pos[kept],
        corners=vertex_map[raw.corners],
        counts=raw.counts,
        faces=faces,
        uv=raw.uv if uv_faces is not None else None,
        uv_faces=uv_faces,
        normal_faces=_shared_normals(raw, rows, faces, notes),
        colours=None if raw.colours is None else raw.colours[kept],
        panels=None if raw.panels is None else {name: mask[polygon] for name, mask in raw.panels.items()},
        stitches=_stitches(raw, vertex_map),
        num_polygons=int((raw.counts > 3).sum()),
        num_joined=len(raw.pos) - len(kept),
        notes=tuple(notes),
    )


def _stitches(raw: RawMesh, vertex_map: np.ndarray) -> np.ndarray | None:
    """Lines between two vertices that there are; others join nothing."""
    if raw.stitches is None:
        return None
    there = ((raw.stitches >= 0) & (raw.stitches < len(raw.pos))).all(axis=1)
    return vertex_map[raw.stitches[there]]


def _check(raw: RawMesh, split_polygons: bool) -> None:
    """Corner counts and vertex indices; with them in order the polygons can be split."""
    far = far_vertex(raw.pos) if np.isfinite(raw.pos).all() else None
    if far is not None:
        raise Unreadable(far)
    if raw.uv is not None and not np.isfinite(raw.uv).all():
        row = int(np.argwhere(~np.isfinite(raw.uv))[0][0])
        raise Unreadable(f"texture coordinate {row + 1} is not finite; repair it, or export without texture coordinates")
    counts, num_vertices = raw.counts, len(raw.pos)
    bad = (counts < 3) | (counts > (MAX_CORNERS if split_polygons else 3))
    outside = (raw.corners < 0) | (raw.corners >= num_vertices)
    face_of_corner = np.repeat(np.arange(len(counts)), np.maximum(counts, 0))
    first_bad = int(np.argmax(bad)) if bad.any() else len(counts)
    first_outside = int(face_of_corner[np.argmax(outside)]) if outside.any() else len(counts)
    if first_outside < first_bad or (first_outside == first_bad < len(counts)):
        corner = int(raw.corners[np.argmax(outside)])
        raise Unreadable(f"face {first_outside} refers to vertex {corner + 1} of {num_vertices}; repair or remove the face")
    if bad.any():
        count = int(counts[first_bad])
        fix = "remove it" if count < 3 else "split it" if split_polygons else "triangulate it or pass triangulate=true"
        raise Unreadable(f"face {first_bad} has {count} corners; {fix}")


def _corner_table(table: np.ndarray | None, size: int, rows: np.ndarray, what: str, notes: list[str]) -> np.ndarray | None:
    """Indices (F, 3) of the triangles' corners; None, with a note, where some faces have none."""
    if table is None:
        return None
    missing = int((table[rows] < 0).any(axis=1).sum())
    if missing:
        notes.append(f"{missing} of {len(rows)} triangles have no {what}s; the others' are not kept")
        return None
    if (table >= size).any():
        raise Unreadable(f"a face refers to {what} {int(table.max()) + 1} of {size}; repair or remove the face")
    return table[rows].astype(np.int64)


def _shared_normals(raw: RawMesh, rows: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray | None:
    """Numbers (F, 3) of the different normals at the different vertices; None where no vertex has two."""
    count = len(raw.normals) if raw.normals is not None else 0
    table = _corner_table(raw.normal_corners, count, rows, "normal", notes)
    if table is None or raw.normals is None or len(faces) == 0:
        return None
    # Files round normals: those within about half a degree are one.
    _, value = np.unique(np.round(raw.normals, 2), axis=0, return_inverse=True)
    key = faces * np.int64(len(raw.normals) + 1) + value.reshape(-1)[table]
    keys, number = np.unique(key, return_inverse=True)
    if len(keys) == len(np.unique(faces)):
        return None
    return number.reshape(faces.shape).astype(np.int64)


def _equal_positions(pos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at equal positions become one, in the order of first appearance: new number of each, and rows that stay."""
    if len(pos) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    _, first, inverse = np.unique(pos, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.argsort(order)
    return rank[inverse.reshape(-1)], first[order]


#: Names of connected parts, which the file gives none.
PART = "part_"


def split_object(name: str | Path) -> tuple[Path, str | None]:
    """The file, and the name of the object in it that is meant; None: all of it. A file that there is by the whole name counts
    before."""
    head, colon, entry = str(name).rpartition(":")
    whole = Path(name).expanduser()
    if not colon or not entry or whole.exists() or not head.lower().endswith(mesh_suffixes()):
        return whole, None
    return Path(head).expanduser(), entry


def parts_by_name(num_vertices: int, faces: np.ndarray) -> dict[str, np.ndarray]:
    """(F,) bool of every connected part, named by its number from 1."""
    label = part_labels(num_vertices, faces)[faces[:, 0]]
    return {f"{PART}{number + 1}": label == number for number in range(int(label.max(initial=-1)) + 1)}


def object_alone(path: Path, mesh: MeshFile, name: str) -> MeshFile:
    """One object, group, material or part of a file, by itself: its vertices and triangles.

    Raises:
        ValueError: there is none of that name; says which there are.
    """
    known = {**parts_by_name(len(mesh.pos), mesh.faces), **(mesh.panels or {})}
    found = meant(name, known)
    if found is None:
        raise ValueError(f"{path}: no object, group, material or part {name!r}; there are {listed(reversed(list(known)))}")
    used, corners = np.unique(mesh.faces[known[found]], return_inverse=True)
    return MeshFile(mesh.pos[used], corners.reshape(-1, 3))
