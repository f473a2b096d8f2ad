"""Meshes for other programs: OBJ files with the texture coordinates and hard edges that the garment came with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.garment.garment import Garment


def write_obj(path: Path, garment: Garment, pos: np.ndarray | None = None) -> None:
    """Write the garment at ``pos`` (V, 3) [m], or at rest, with ``vt`` and ``vn``.

    Vertices and faces keep their numbers. Normals are those of ``pos``: what a cloth had at rest is wrong once it moves;
    which corners share one is what the garment keeps.
    """
    pos = garment.rest_pos if pos is None else pos
    corners = garment.faces if garment.normal_faces is None else garment.normal_faces
    normals = corner_normals(pos, garment.faces, corners)
    text = obj_points(garment.name, pos, normals) + obj_faces(garment.faces, corners, garment.uv, garment.uv_faces)
    write_atomically(path, text.encode())


def obj_points(name: str, pos: np.ndarray, normals: np.ndarray) -> str:
    """Lines of an OBJ file for positions (V, 3) [m], which float32 reads back to the bit, and normals (N, 3)."""
    lines = [f"o {name}", *("v {:.9g} {:.9g} {:.9g}".format(*row) for row in pos.tolist())]
    lines += ["vn {:.5f} {:.5f} {:.5f}".format(*row) for row in normals.tolist()]
    return "\n".join(lines) + "\n"


def obj_faces(faces: np.ndarray, normal_faces: np.ndarray, uv: np.ndarray | None, uv_faces: np.ndarray | None) -> str:
    """Lines of an OBJ file for faces (F, 3) with normals, and with texture coordinates ``uv`` (U, 2) where ``uv_faces`` (F, 3)
    says which corner has which; what is the same in every frame."""
    lines = [] if uv is None else ["vt {:.7g} {:.7g}\n".format(*row) for row in uv.tolist()]
    if uv is None or uv_faces is None:
        both, form = np.concatenate([faces, normal_faces], axis=1), "f {0}//{3} {1}//{4} {2}//{5}\n"
    else:
        both, form = np.concatenate([faces, normal_faces, uv_faces], axis=1), "f {0}/{6}/{3} {1}/{7}/{4} {2}/{8}/{5}\n"
    return "".join([*lines, *(form.format(*row) for row in (both + 1).tolist())])


def corner_normals(pos: np.ndarray, faces: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Unit normals (M, 3), one per number in ``corners`` (F, 3): area-weighted over the faces that share it."""
    a, b, c = (pos[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    total = np.zeros((int(corners.max(initial=-1)) + 1, 3))
    for k in range(3):
        np.add.at(total, corners[:, k], cross)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
