"""One object of a mesh file, by a name behind the file's: ``scene.obj:Avatar``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.assets.files.folded import meant
from hood.assets.files.guarded import listed
from hood.assets.formats.mesh_file import MeshFile, mesh_suffixes
from hood.mesh.parts import part_labels

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
