"""Reading a moving mesh that serves as a body, at the frame rate of the simulation; or one of arrays."""

from __future__ import annotations

import mmap
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.library import DATA_FOLDER
from hood.assets.files.said import Doubt
from hood.assets.files.text import parse_rate
from hood.assets.formats import vertex_files
from hood.assets.formats.gltf_animation import read_gltf_animation
from hood.assets.formats.mesh_file import object_alone, read_mesh_file, split_object
from hood.assets.formats.vertex_files import (
    CACHE_SUFFIX,
    FACE_KEYS,
    FOLDER_SUFFIXES,
    VERTEX_KEYS,
    VertexFile,
    caches,
    read_point_cache,
)
from hood.assets.motion.mesh_sequence import MeshSequence, loop_mesh, resample_mesh, trim_mesh, turn_mesh
from hood.assets.motion.sequence import rate_of, real_rows
from hood.assets.motion.skeleton import require_up
from hood.mesh import topology
from hood.mesh.editing.repair import sew_moving

NO_BODY = "none"
_STILL_SUFFIXES = (".obj", ".ply", ".off", ".stl")
_GLTF_SUFFIXES = (".glb", ".gltf")
_H5_SUFFIXES = (".h5", ".hdf5")
#: What can be given as a moving or still mesh, besides a folder of OBJ or PLY files.
ANIMATED_SUFFIXES = (".npz", ".pkl", CACHE_SUFFIX, *_H5_SUFFIXES, *_GLTF_SUFFIXES, *_STILL_SUFFIXES)
_DEFAULT_FPS = 30.0
#: A body larger than this [m] is in other units. Of these [m per unit] that is named which brings it nearest to a person [m].
_LARGEST, _UNITS, _USUAL = 30.0, (1.0, 0.01, 0.001), 1.7
#: Sizes [m] of bodies, from dolls to horses: who names a unit that gives another one is told.
_PERSONS = (0.25, 4.0)
#: Units [m] of which persons of 4 to 30 m are, feet and decimetres; they are at least so tall, of their largest extent, and at
#: most so deep.
_LARGE_UNITS, _TALL, _FLAT = (0.3048, 0.1), 0.8, 0.4
#: A body stands along z where it is so many times longer than along y, and no plane: at least this share as thick, and not
#: filled like a box [share of it].
_LONGER, _THICK, _FILLED = 2.5, 0.1, 0.4


@dataclass(frozen=True)
class BodyMesh:
    """A body of arrays: a mesh that moves, or stands still, as :func:`hood.simulate` takes it for ``body``.

    Cloth needs an inside and an outside: the mesh is closed, its faces look outwards.

    Args:
        vertices: (T, W, 3) m, y up, of every frame; (W, 3) for a body that stands still. Moved linearly between frames.
        faces: (G, 3) vertex numbers from 0.
        fps: frames per second of ``vertices``.
        name: for messages.

    Raises:
        ValueError: arrays of another shape or type, not finite, or faces without vertices; names the argument, the index and
            the fix.
    """

    vertices: np.ndarray
    faces: np.ndarray
    fps: float = _DEFAULT_FPS
    name: str = "body"

    def __post_init__(self) -> None:
        vertices = real_rows("body", "vertices", self.vertices, "(frames, vertices, 3)", (2, 3), 3, single=True)
        vertices = vertices[None] if vertices.ndim == 2 else vertices
        faces = _triangles(self.faces, vertices.shape[1])
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        object.__setattr__(self, "fps", rate_of("body", self.fps))


def _triangles(given: Any, count: int) -> np.ndarray:
    """(G, 3) int64: faces of ``count`` vertices."""
    faces = np.asarray(given.detach().cpu() if hasattr(given, "detach") else given)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise ValueError(f"body: faces have shape {faces.shape}; give (faces, 3), polygons split into triangles")
    if faces.dtype.kind not in "iu":
        raise ValueError(f"body: faces are of type {faces.dtype}; give whole numbers, faces.astype(int)")
    outside = ((faces < 0) | (faces >= count)).any(axis=1)
    if outside.any():
        row = int(outside.argmax())
        raise ValueError(f"body: faces[{row}] is {faces[row].tolist()}; give vertex numbers from 0 to {count - 1}")
    return np.ascontiguousarray(faces, dtype=np.int64)


def body_kind(name: str | Path) -> str:
    """What is meant by a body: ``"model"`` (embedded or of the SMPL family), ``"mesh"`` (moving or still), ``"none"``."""
    path, _ = split_object(name)
    if str(name) == NO_BODY:
        return NO_BODY
    if (DATA_FOLDER / "body" / f"{name}.npz").is_file():
        return "model"
    if path.is_dir():
        return "mesh" if any(entry.suffix.lower() in (*FOLDER_SUFFIXES, CACHE_SUFFIX) for entry in path.iterdir()) else "model"
    suffix = path.suffix.lower()
    if suffix in (CACHE_SUFFIX, *_H5_SUFFIXES, *_GLTF_SUFFIXES, *_STILL_SUFFIXES):
        return "mesh"
    if suffix in (".npz", ".pkl") and path.is_file():
        return "mesh" if _holds_vertices(path) else "model"
    return "model"


def load_mesh_sequence(
    path: str | Path,
    fps: float = 30.0,
    up: str = "auto",
    *,
    start: float | str | None = None,
    stop: float | str | None = None,
    loop: int = 1,
    file_fps: float | None = None,
    scale: float | None = None,
    animation: int | str = 0,
    parts: Sequence[str] = (),
) -> MeshSequence:
    """A moving mesh at ``fps``: vertices move linearly between the frames of the file.

    Accepted: a folder of numbered OBJ or PLY files; a PC2 point cache with its OBJ or PLY beside it, or their folder;
    ``.npz``, ``.h5`` or ``.pkl`` with ``verts (N, W, 3)`` and ``faces`` (a ``rollout.h5`` as well); ``.glb`` or ``.gltf``,
    whose animation is evaluated at ``fps`` itself; OBJ, PLY, OFF or STL for one that stands still. A name behind that of a
    still mesh or of glTF, ``scene.obj:Avatar``, is that of the object, group, material or part (``part_1``) that is the body.

    Args:
        up: axis that points up in the file: "y", "z", "x", "-y", "-z", "-x", or "auto", y, with a doubt where it seems to be z.
        start, stop: part to keep, in seconds or in frames of the file ("120f").
        loop: times the motion is played; it must end as it began.
        file_fps: frame rate of the file, whatever it says itself; 30, with a doubt, where neither does.
        scale: metres per unit of the file; None: 1. Refused where the mesh is larger than 30 m then; a given one is warned of
            where it makes no person. 1 takes the mesh as it is.
        animation, parts: of glTF, see :func:`hood.assets.formats.gltf_animation.read_gltf_animation`.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: unreadable, wrong shapes or indices, not finite, other units; names the file and the fix.
    """
    path, entry = split_object(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    require_up(up)
    content = _read(path, fps, animation, parts, entry)
    said = content.fps if file_fps is None else file_fps
    rate = _rate(path, said)
    verts, faces = _checked(path, content.verts, content.faces)
    assumed = said is None and len(verts) > 1
    if assumed:
        sentence = f"{path}: says no frame rate, {rate:g} fps are assumed; file_fps=… gives the right one"
        warnings.warn(Doubt("frame_rate", sentence, value=rate, unit="fps"), stacklevel=2)
    bones = _bones(path, content)
    skin = bones, content.rest, content.weights, content.joints
    sequence = MeshSequence(path.stem, verts, faces, rate, *skin, fps_assumed=assumed)
    return _performed(path, sequence, fps, up, start, stop, loop, scale)


def perform_mesh(
    mesh: BodyMesh,
    fps: float = 30.0,
    up: str = "auto",
    *,
    start: float | str | None = None,
    stop: float | str | None = None,
    loop: int = 1,
    scale: float | None = None,
) -> MeshSequence:
    """The same of arrays, as they were read from a file that says its frame rate; see :func:`load_mesh_sequence`.

    Raises:
        ValueError: an option out of range, or a mesh in other units.
    """
    require_up(up)
    sequence = MeshSequence(mesh.name, mesh.vertices, mesh.faces, mesh.fps)
    return _performed(mesh.name, sequence, fps, up, start, stop, loop, scale)


def _performed(
    path: Path | str,
    sequence: MeshSequence,
    fps: float,
    up: str,
    start: float | str | None,
    stop: float | str | None,
    loop: int,
    scale: float | None,
) -> MeshSequence:
    """A mesh as it is to be performed; ``path`` names it in messages."""
    sequence = turn_mesh(sequence, 1.0 if scale is None else float(scale), up)
    _check_size(path, sequence, scale)
    if up == "auto":
        _check_bearing(path, sequence)
    sequence = resample_mesh(trim_mesh(sequence, start, stop), fps)
    sequence = replace(sequence, faces=_sewn(path, sequence))
    return replace(loop_mesh(sequence, loop), faces=_outward(path, sequence))


def _read(path: Path, fps: float, animation: int | str, parts: Sequence[str], entry: str | None) -> VertexFile:
    suffix = path.suffix.lower()
    if suffix == CACHE_SUFFIX or (path.is_dir() and caches(path)):
        return read_point_cache(path)
    if path.is_dir():
        return vertex_files.read_mesh_folder(path)
    if suffix in _GLTF_SUFFIXES:
        scene = read_gltf_animation(path, fps, animation, parts if entry is None else (entry,))
        skinned = scene.transforms is not None
        rest = scene.rest if skinned else None
        return VertexFile(scene.verts, scene.faces, fps, scene.transforms, rest, scene.weights, scene.joints)
    if suffix in _STILL_SUFFIXES:
        mesh = read_mesh_file(path, True)
        mesh = mesh if entry is None else object_alone(path, mesh, entry)
        return VertexFile(mesh.pos, mesh.faces)
    readers = {".npz": vertex_files.read_vertex_archive, ".pkl": vertex_files.read_vertex_pickle}
    readers |= dict.fromkeys(_H5_SUFFIXES, vertex_files.read_vertex_h5)
    if suffix not in readers:
        raise ValueError(f"{path}: unknown format {path.suffix!r} of a moving mesh; give one of {', '.join(ANIMATED_SUFFIXES)}")
    return readers[suffix](path)


def _holds_vertices(path: Path) -> bool:
    """Whether an archive or pickle names vertices and no body model; nothing of it is read."""
    if path.suffix.lower() == ".pkl":
        if path.stat().st_size == 0:
            return False
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            # Keys of a dict stand in a pickle as they are.
            named = content.find(b"verts") >= 0 or content.find(b"vertices") >= 0
            return named and content.find(b"v_template") < 0
    try:
        with zipfile.ZipFile(path) as archive:
            keys = {name.removesuffix(".npy") for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError):
        return False
    return bool(keys & set(VERTEX_KEYS)) and bool(keys & set(FACE_KEYS)) and "v_template" not in keys


def _checked(path: Path, verts: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    verts, faces = np.asarray(verts), np.asarray(faces)
    if verts.dtype.kind not in "iuf" or faces.dtype.kind not in "iuf":
        raise ValueError(f"{path}: verts hold {verts.dtype} and faces {faces.dtype} values; they must hold numbers")
    if verts.ndim == 2:
        verts = verts[None]
    if verts.ndim != 3 or verts.shape[2] != 3 or verts.shape[0] < 1 or verts.shape[1] < 3:
        raise ValueError(f"{path}: verts have shape {verts.shape}; they must be (frames, vertices, 3)")
    if faces.ndim != 2 or faces.shape[1] not in (3, 4) or len(faces) == 0:
        raise ValueError(f"{path}: faces have shape {faces.shape}; they must be (faces, 3) vertex indices")
    if verts.dtype.kind != "f" or verts.dtype.itemsize < 4:
        verts = verts.astype(np.float32 if verts.dtype.kind == "f" else np.float64)
    indices = faces.astype(np.int64)
    if not np.array_equal(indices, faces) or indices.min() < 0 or indices.max() >= verts.shape[1]:
        raise ValueError(
            f"{path}: faces refer to vertices {faces.min()} … {faces.max()} of {verts.shape[1]}; indices count from 0"
        )
    if indices.shape[1] == 4:
        indices = np.concatenate([indices[:, [0, 1, 2]], indices[:, [0, 2, 3]]])
    for frame, points in enumerate(verts):
        if not np.isfinite(points).all():
            raise ValueError(f"{path}: vertices are not finite in frame {frame}; remove or repair that frame")
    return verts, indices


def _bones(path: Path, content: VertexFile) -> np.ndarray | None:
    if content.transforms is None:
        return None
    bones = np.asarray(content.transforms)
    frames = len(content.verts) if np.ndim(content.verts) == 3 else 1
    if bones.dtype.kind != "f" or bones.ndim != 4 or len(bones) != frames or bones.shape[2:] not in ((3, 4), (4, 4)):
        raise ValueError(f"{path}: transforms have shape {bones.shape}; they must be ({frames}, joints, 3 or 4, 4) reals")
    if not np.isfinite(bones).all():
        raise ValueError(f"{path}: transforms are not finite; repair them")
    return bones[:, :, :3].astype(np.float64)


def _rate(path: Path, value: Any) -> float:
    if value is None:
        return _DEFAULT_FPS
    rate = parse_rate(value)
    if not 0.1 <= rate <= 1e5:
        raise ValueError(
            f"{path}: its frame rate is {' '.join(str(value).split())[:40]}; give file_fps, 0.1 to 100000 frames a second"
        )
    return rate


def _check_size(path: Path | str, sequence: MeshSequence, scale: float | None) -> None:
    extent = float(np.ptp(sequence.verts[0], axis=0).max())
    if extent <= 0:
        raise ValueError(f"{path}: all vertices of its first frame are at one point; it is no surface")
    if scale == 1.0:
        return
    given = 1.0 if scale is None else float(scale)
    factor = min(_UNITS, key=lambda unit: abs(np.log(unit * extent / given / _USUAL)))
    fix = f"{_pass_unit(factor)}, which makes it {factor * extent / given:.3g} m"
    fix += "" if factor == 1.0 else " (unit=m takes it as it is)"
    if extent > _LARGEST:
        unit = "its unit is not the metre" if scale is None else f"unit={scale:g} is not that of the file"
        raise ValueError(f"{path}: the mesh is {extent:.4g} m large; {unit}, {fix}")
    if scale is None and extent > _PERSONS[1] and _is_upright(np.ptp(sequence.verts[0], axis=0)):
        factor = min(_LARGE_UNITS, key=lambda unit: abs(np.log(unit * extent / _USUAL)))
        fix = f"{_pass_unit(factor)}, which makes it {factor * extent:.3g} m (unit=m takes it as it is)"
        sentence = f"{path}: the body is {extent:.3g} m tall, its unit seems not to be the metre; {fix}"
        warnings.warn(Doubt("units", sentence, value=extent, unit="m"), stacklevel=3)
    if scale is not None and not _PERSONS[0] <= extent <= _PERSONS[1] and factor != scale:
        sentence = f"{path}: the mesh is {extent:.3g} m large with unit={scale:g}; {fix}"
        warnings.warn(Doubt("units", sentence, value=extent, unit="m"), stacklevel=3)


def _pass_unit(metres: float) -> str:
    return f"pass unit={metres:g} (body_scale={metres:g} in hood prepare)"


def _is_upright(box: np.ndarray) -> bool:
    """Whether a box (3,) has the shape of a standing person's, arms down or held out: high along y, and not deep."""
    return bool(box[1] >= _TALL * box.max() and box.min() <= _FLAT * box.max())


def _check_bearing(path: Path | str, sequence: MeshSequence) -> None:
    """Warn of a mesh that lies along z in its first frame, as a body does that stands in a file with z up."""
    points = sequence.verts[0].astype(np.float64)
    box = np.ptp(points, axis=0)
    long = _LONGER * box[1] < box[2] <= _PERSONS[1] and box[1] > _THICK * box[2]
    if long and abs(_volume(points, sequence.faces)) < _FILLED * box.prod():
        sentence = (
            f"{path}: the body seems to stand along z (it is {box[2]:.2f} m long there, {box[1]:.2f} m along y), but y is "
            "taken as up; pass up=z (body_up=z in hood prepare) if it stands, up=y (body_up=y) if it lies"
        )
        warnings.warn(Doubt("orientation", sentence), stacklevel=3)


def _volume(points: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume [m³] of a closed mesh (W, 3), (G, 3): below zero where its faces look inwards."""
    a, b, c = (points[faces[:, corner]] - points.mean(axis=0) for corner in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6.0


def _sewn(path: Path | str, sequence: MeshSequence) -> np.ndarray:
    """The faces, with vertices that seams double joined: inside and outside need a closed body."""
    before = len(topology.boundary_loops(sequence.faces))
    if not before:
        return sequence.faces
    faces = sew_moving(sequence.verts, sequence.faces)
    after = len(topology.boundary_loops(faces))
    if after < before:
        warnings.warn(
            f"{path}: the body has {before} openings where seams double its vertices; joined, it has {after}", stacklevel=3
        )
    if after:
        warnings.warn(
            f"{path}: the body has {after} opening{'s' if after > 1 else ''}, and inside and outside need a closed one; "
            "close them where it was made",
            stacklevel=3,
        )
    return faces


def _outward(path: Path | str, sequence: MeshSequence) -> np.ndarray:
    """The faces, turned over where a closed mesh is inside out: cloth would be drawn into it."""
    faces, points = sequence.faces, sequence.verts[0].astype(np.float64)
    closed = 2 * len(topology.unique_edges(faces)) == 3 * len(faces)
    if not closed or _volume(points, faces) >= 0:
        return faces
    warnings.warn(f"{path}: the faces of the mesh look inwards; they are turned over", stacklevel=3)
    return np.ascontiguousarray(faces[:, ::-1])
