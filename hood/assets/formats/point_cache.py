"""Point caches (PC2) of Blender, Houdini and others: all positions of a mesh that lies beside them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from hood.assets.files.library import SIZE_LIMIT
from hood.assets.formats.mesh_file import read_mesh
from hood.assets.formats.vertex_files import FOLDER_SUFFIXES, VertexFile

CACHE_SUFFIX = ".pc2"
_MAGIC = b"POINTCACHE2\0"
#: Signature, version, points, first frame, frames from one sample to the next, samples.
_HEADER = struct.Struct("<12siiffi")
#: Frames per second of the scene, which the file does not hold.
_SCENE_FPS = 30.0


def caches(folder: Path) -> list[Path]:
    """The point caches in a folder, by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == CACHE_SUFFIX)


def read_point_cache(path: Path) -> VertexFile:
    """A PC2 file, or a folder that holds one; its faces are those of the OBJ or PLY of the same name, or of the only one there.

    Samples are as far apart as the file says, at 30 frames a second of the scene.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no single cache in the folder, no single mesh beside it, a damaged or too large file, or a mesh of other
            vertices; names the file and the fix.
    """
    if path.is_dir():
        found = caches(path)
        if len(found) != 1:
            raise ValueError(f"{path}: holds {len(found)} point caches ({_listed(found)}); give the one that is meant")
        path = found[0]
    with open(path, "rb") as file:
        head = file.read(_HEADER.size)
        size = path.stat().st_size - _HEADER.size
        if len(head) < _HEADER.size or not head.startswith(_MAGIC):
            raise ValueError(f"{path}: not a PC2 point cache: its first bytes are not POINTCACHE2; write it again")
        _, _, points, _, apart, samples = _HEADER.unpack(head)
        if points < 1 or samples < 1 or not (np.isfinite(apart) and apart > 0):
            raise ValueError(f"{path}: {samples} samples of {points} points, {apart:g} frames apart; write the cache again")
        if size != 12 * points * samples:
            raise ValueError(
                f"{path}: {samples} samples of {points} points need {12 * points * samples} bytes, it holds {size}; it is cut "
                "off or no PC2 file: write it again"
            )
        if size > SIZE_LIMIT:
            raise ValueError(f"{path}: {size} bytes are more than {SIZE_LIMIT}; write fewer frames")
        verts = np.frombuffer(file.read(size), "<f4").reshape(samples, points, 3)
    mesh = _mesh_beside(path)
    pos, faces = read_mesh(mesh, True)
    if len(pos) != points:
        raise ValueError(f"{path}: {points} points, {mesh.name} beside it has {len(pos)} vertices; write both from one mesh")
    return VertexFile(verts.astype(np.float32), faces, _SCENE_FPS / apart)


def _mesh_beside(cache: Path) -> Path:
    """The mesh file whose faces a cache has."""
    meshes = sorted(path for path in cache.parent.iterdir() if path.suffix.lower() in FOLDER_SUFFIXES)
    own = [path for path in meshes if path.stem == cache.stem]
    chosen = own or meshes
    if len(chosen) != 1:
        raise ValueError(
            f"{cache}: a point cache has no faces, and {len(chosen)} meshes could have them ({_listed(chosen)}); put the mesh "
            f"beside it as {cache.stem}.obj"
        )
    return chosen[0]


def _listed(paths: list[Path]) -> str:
    return ", ".join(path.name for path in paths[:4]) + (" …" if len(paths) > 4 else "") if paths else "none"
