"""Meshes for other programs: OBJ files with the texture coordinates and hard edges that the garment came with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.assets.atomic import write_atomically
from hood.assets.garment import Garment


def write_obj(path: Path, garment: Garment, pos: np.ndarray | None = None) -> None:
    """Write the garment at ``pos`` (V, 3) [m], or at rest, with ``vt`` and ``vn``.

    Vertices and faces keep their numbers. Normals are those of ``pos``: what a cloth had at rest is wrong once it moves;
    which corners share one is what the garment keeps.
    """
    pos = garment.rest_pos if pos is None else pos
    corners = garment.faces if garment.normal_faces is None else garment.normal_faces
    normals = corner_normals(pos, garment.faces, corners)
    lines = [f"o {garment.name}", *("v {:.7g} {:.7g} {:.7g}".format(*row) for row in pos.tolist())]
    textured = garment.uv is not None and garment.uv_faces is not None
    if garment.uv is not None:
        lines += ["vt {:.7g} {:.7g}".format(*row) for row in garment.uv.tolist()]
    lines += ["vn {:.5f} {:.5f} {:.5f}".format(*row) for row in normals.tolist()]
    uv_faces = garment.uv_faces if garment.uv_faces is not None else garment.faces
    for face, texture, normal in zip(
        (garment.faces + 1).tolist(), (uv_faces + 1).tolist(), (corners + 1).tolist(), strict=True
    ):
        words = (f"{v}/{t if textured else ''}/{n}" for v, t, n in zip(face, texture, normal, strict=True))
        lines.append("f " + " ".join(words))
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def corner_normals(pos: np.ndarray, faces: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Unit normals (M, 3), one per number in ``corners`` (F, 3): area-weighted over the faces that share it."""
    a, b, c = (pos[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    total = np.zeros((int(corners.max(initial=-1)) + 1, 3))
    for k in range(3):
        np.add.at(total, corners[:, k], cross)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
