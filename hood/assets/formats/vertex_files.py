"""Files that hold moving vertices: archives, HDF5, pickles, folders of numbered meshes; each reader for one format.

Point caches (PC2, MDD) of Blender, Houdini and others: all positions of a mesh that lies beside them.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from hood.assets.files.guarded import check_size, first_line, guarded, own_dataset
from hood.assets.files.library import SIZE_LIMIT, read_arrays
from hood.assets.files.text import rates_in
from hood.assets.formats.mesh_file import MeshFile, read_mesh, read_mesh_file
from hood.assets.pickles.records import load_pickle

#: Names of the tables; the last pair is the body of a ``rollout.h5``.
VERTEX_KEYS = ("verts", "vertices", "body/pos")
FACE_KEYS = ("faces", "f", "body/faces")
FOLDER_SUFFIXES = (".obj", ".ply")
#: An HDF5 file may be stored compressed; what it unpacks to is limited, not its size.
_OTHER_KEYS = ("transforms",)


class VertexFile(NamedTuple):
    """Moving vertices as a file has them, not yet checked."""

    verts: Any  # (N, W, 3), or (W, 3) of a still mesh
    faces: Any  # (G, 3) or (G, 4)
    fps: Any = None  # number, None where the file does not say
    transforms: Any = None  # (N, J, 3, 4) or (N, J, 4, 4)
    rest: np.ndarray | None = None  # (W, 3), of glTF
    weights: np.ndarray | None = None  # (W, J), of glTF
    joints: tuple[str, ...] = ()  # names of J, of glTF


def read_vertex_archive(path: Path) -> VertexFile:
    """``.npz`` with ``verts (N, W, 3)``, ``faces (G, 3)``, and optionally ``fps`` and ``transforms (N, J, 3 or 4, 4)``.

    Raises:
        ValueError: unreadable, larger than the limit, or a missing key; names the file.
    """
    return _pick(path, read_arrays(path, (), "mesh sequence"))


def read_vertex_pickle(path: Path) -> VertexFile:
    """The same keys in a ``.pkl``, read by the restricted unpickler.

    Raises:
        ValueError: unreadable, naming a class that is not read, or a missing key; names the file.
    """
    content = load_pickle(path, SIZE_LIMIT)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}, not a mesh sequence; it must be a dict of arrays")
    return _pick(path, content)


def read_vertex_h5(path: Path) -> VertexFile:
    """The same keys as datasets of an HDF5 file (``fps`` may be an attribute), or the body of a ``rollout.h5``.

    Raises:
        ValueError: unreadable, larger than the limit, data in other files, or a missing key; names the file.
    """
    try:
        with h5py.File(path, "r") as file:
            found: dict[str, Any] = {
                key: _dataset(file, key) for key in (*VERTEX_KEYS, *FACE_KEYS, *_OTHER_KEYS) if key in file
            }
            if not found.keys() & set(VERTEX_KEYS) and "store" in file.attrs:
                raise ValueError(f"a rollout of formats=[{file.attrs['store']}], whose body is no mesh here; make it without")
            said = next(rates_in({key: _small(file, key) for key in file} | dict(file.attrs)), None)
            found |= {} if said is None else {"fps": said[1]}
            if "body/pos" in found and "dt" in file.attrs:
                found["fps"] = 1.0 / float(file.attrs["dt"])
                found["body/pos"] = found["body/pos"][: int(file.attrs.get("num_frames", len(found["body/pos"])))]
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable HDF5 mesh sequence ({first_line(error)})") from error
    return _pick(path, found)


def read_mesh_folder(folder: Path) -> VertexFile:
    """A folder of OBJ or PLY files, one a frame, in the order of the numbers in their names; polygons are split once.

    Raises:
        ValueError: no such files, both kinds, or a frame with other vertices or faces than the first; names the file.
    """
    files = sorted((path for path in folder.iterdir() if path.suffix.lower() in FOLDER_SUFFIXES), key=_number)
    if not files:
        raise ValueError(f"{folder}: no OBJ or PLY files in this folder; give one mesh a frame, numbered")
    if len({path.suffix.lower() for path in files}) > 1:
        raise ValueError(f"{folder}: holds OBJ and PLY files; keep one kind")
    if sum(path.stat().st_size for path in files) > 4 * SIZE_LIMIT:
        raise ValueError(f"{folder}: more than {4 * SIZE_LIMIT} bytes of meshes; save them as one .npz (verts, faces)")
    mesh = read_mesh_file(files[0], True)
    first, faces = mesh.pos, mesh.faces
    if first.nbytes * len(files) > SIZE_LIMIT:
        raise ValueError(f"{folder}: {len(files)} frames of {len(first)} vertices are more than {SIZE_LIMIT} bytes; give fewer")
    verts = np.empty((len(files), *first.shape))
    verts[0] = first
    for frame, path in enumerate(files[1:], start=1):
        own = read_mesh_file(path, True)
        pos = own.pos
        if pos.shape != first.shape:
            raise ValueError(
                f"{path}: {len(pos)} vertices, {files[0].name} has {len(first)}; every frame must be the same mesh"
            )
        # Polygons are split by their shape, and that changes: the split of the first frame is that of all.
        if not _same_polygons(own, mesh):
            raise ValueError(f"{path}: its faces are not those of {files[0].name}; every frame must be the same mesh")
        verts[frame] = pos
    return VertexFile(verts, faces)


def read_points_folder(folder: Path) -> list[np.ndarray]:
    """Points (P, 3) [m] of a folder of OBJ or PLY files, one a frame, in the order of the numbers in their names; faces may be
    there or not.

    Raises:
        ValueError: no such files, a number between the first and the last that is missing, or a file without points.
    """
    import trimesh

    files = sorted((path for path in folder.iterdir() if path.suffix.lower() in FOLDER_SUFFIXES), key=_number)
    if not files:
        raise ValueError(f"{folder}: no OBJ or PLY files in this folder; give one a frame, numbered")
    numbers = [(_number(path)[0] or [0])[-1] for path in files]
    missing = next((before + 1 for before, after in zip(numbers, numbers[1:], strict=False) if after != before + 1), None)
    if missing is not None and len(files) > 1:
        raise ValueError(
            f"{folder}: there is no frame {missing} between {files[0].name} and {files[-1].name}; number them 0, 1, 2, …"
        )
    frames = []
    for path in files:
        check_size(path, SIZE_LIMIT)
        read = guarded(path, f"{path.suffix[1:].upper()} file", partial(trimesh.load, path, process=False))
        points = np.asarray(getattr(read, "vertices", np.zeros((0, 3))), dtype=np.float64)
        if not len(points):
            raise ValueError(f"{path}: holds no points")
        frames.append(points)
    return frames


def _same_polygons(one: MeshFile, other: MeshFile) -> bool:
    pairs = ((one.corners, other.corners), (one.counts, other.counts))
    return all(a is not None and b is not None and np.array_equal(a, b) for a, b in pairs)


def _pick(path: Path, fields: Mapping[Any, Any]) -> VertexFile:
    verts = next((fields[key] for key in VERTEX_KEYS if key in fields), None)
    faces = next((fields[key] for key in FACE_KEYS if key in fields), None)
    if verts is None or faces is None:
        missing = "verts" if verts is None else "faces"
        found = sorted(str(key) for key in fields)[:8]
        raise ValueError(f"{path}: not a mesh sequence: key {missing!r} is missing (found {found})")
    _, rate = next(rates_in({str(key): value for key, value in fields.items()}), (None, None))
    return VertexFile(verts, faces, rate, fields.get("transforms"))


def _small(file: h5py.File, key: str) -> Any:
    """A dataset of one value; None for what is larger, and for groups and links."""
    place = file.get(key, getlink=True)
    if not isinstance(place, h5py.HardLink) or not isinstance(file[key], h5py.Dataset) or file[key].size != 1:
        return None
    return file[key][()]


def _dataset(file: h5py.File, key: str) -> np.ndarray:
    place = own_dataset(file, key)
    size = math.prod(place.shape or ()) * place.dtype.itemsize
    if size > SIZE_LIMIT:
        raise ValueError(f"{key} has shape {place.shape}, {size} bytes, the limit is {SIZE_LIMIT}")
    if place.dtype.kind not in "iufb":
        raise ValueError(f"{key} holds {place.dtype} values; it must hold numbers")
    # Chunks that were never written take no room in the file and all of it in memory.
    if size > 1 << 24 and size > 2000 * max(place.id.get_storage_size(), 1):
        raise ValueError(f"{key} claims {size} bytes and stores {place.id.get_storage_size()}; the file is damaged")
    return np.asarray(place[()])


def _number(path: Path) -> tuple[list[int], str]:
    """Sort key: the numbers in a name, so that frame_10 comes after frame_9."""
    return [int(digits[-18:]) for digits in re.findall(r"\d+", path.stem)], path.name


CACHE_SUFFIXES = (".pc2", ".mdd")
_MAGIC = b"POINTCACHE2\0"
#: Signature, version, points, first frame, frames from one sample to the next, samples.
_HEADER = struct.Struct("<12siiffi")
#: Of MDD, whose numbers begin with the largest byte: samples, points; the time [s] of each follows.
_MDD_HEADER = struct.Struct(">ii")
#: Frames per second of the scene, which the file does not hold.
_SCENE_FPS = 30.0
#: Samples of MDD that are farther apart [s] are numbered, not timed; and by how much [share] they may be uneven.
_NUMBERED, _UNEVEN = 0.5, 0.05


def caches(folder: Path) -> list[Path]:
    """The point caches in a folder, by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in CACHE_SUFFIXES)


def read_point_cache(path: Path) -> VertexFile:
    """A PC2 or MDD file, or a folder that holds one; its faces are those of the OBJ or PLY of the same name, or of the only one
    there.

    Samples of PC2 are as far apart as the file says, at 30 frames a second of the scene; those of MDD have times.

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
    verts, fps = (_read_mdd if path.suffix.lower() == ".mdd" else _read_pc2)(path)
    mesh, points = _mesh_beside(path), verts.shape[1]
    pos, faces = read_mesh(mesh, True)
    if len(pos) != points:
        raise ValueError(f"{path}: {points} points, {mesh.name} beside it has {len(pos)} vertices; write both from one mesh")
    return VertexFile(verts.astype(np.float32), faces, fps)


def _read_pc2(path: Path) -> tuple[np.ndarray, float]:
    """Positions (N, W, 3) and frames per second."""
    with open(path, "rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size or not head.startswith(_MAGIC):
            raise ValueError(f"{path}: not a PC2 point cache: its first bytes are not POINTCACHE2; write it again")
        _, _, points, _, apart, samples = _HEADER.unpack(head)
        if points < 1 or samples < 1 or not (np.isfinite(apart) and apart > 0):
            raise ValueError(f"{path}: {samples} samples of {points} points, {apart:g} frames apart; write the cache again")
        _check_cache(path, samples, points, path.stat().st_size - _HEADER.size, 0)
        return np.frombuffer(file.read(), "<f4").reshape(samples, points, 3), _SCENE_FPS / apart


def _read_mdd(path: Path) -> tuple[np.ndarray, float | None]:
    """The same; None where the file numbers its samples or holds one."""
    with open(path, "rb") as file:
        head = file.read(_MDD_HEADER.size)
        samples, points = _MDD_HEADER.unpack(head) if len(head) == _MDD_HEADER.size else (0, 0)
        if points < 1 or samples < 1:
            raise ValueError(f"{path}: {samples} samples of {points} points; it is no MDD file: write the cache again")
        _check_cache(path, samples, points, path.stat().st_size - _MDD_HEADER.size, 4 * samples)
        times = np.frombuffer(file.read(4 * samples), ">f4").astype(np.float64)
        verts = np.frombuffer(file.read(), ">f4").reshape(samples, points, 3)
    if samples == 1:
        return verts, None
    steps, apart = np.diff(times), (times[-1] - times[0]) / (samples - 1)
    if not (np.isfinite(times).all() and apart > 0 and np.abs(steps - apart).max() <= _UNEVEN * apart):
        raise ValueError(
            f"{path}: its samples are {steps.min():.3g} to {steps.max():.3g} s apart; write them at one frame rate"
        )
    return verts, None if apart > _NUMBERED else round(1.0 / apart, 3)


def _check_cache(path: Path, samples: int, points: int, size: int, before: int) -> None:
    """Refuse a cache whose ``size`` [bytes] behind its header is another than that of the positions and what is ``before``."""
    needed = before + 12 * points * samples
    if size != needed:
        kind = path.suffix[1:].upper()
        raise ValueError(
            f"{path}: {samples} samples of {points} points need {needed} bytes, it holds {size}; it is cut off or no {kind} "
            "file: write it again"
        )
    if size > SIZE_LIMIT:
        raise ValueError(f"{path}: {size} bytes are more than {SIZE_LIMIT}; write fewer frames")


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
