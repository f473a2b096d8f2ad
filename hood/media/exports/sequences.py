"""Meshes for other programs: OBJ files with the texture coordinates and hard edges of the garment, a mesh file a frame
(OBJ, PLY), and one mesh with a point cache (OBJ and PC2 or MDD).

Moving meshes as other programs know them: named parts, a frame rate, one origin.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.formats.raw_mesh import Texture
from hood.assets.garment.garment import Garment
from hood.media.pieces import looks_of, pieces_of
from hood.media.renderer.render import BODY_COLOR
from hood.mesh.editing.subdivision import Extrusion
from hood.rollouts.file.reader import RolloutData


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


def write_obj_sequence(folder: Path, clip: Clip) -> None:
    """``NAME_0001.obj`` … of every part, with texture coordinates and normals; an image comes with ``NAME.mtl``."""
    for part in clip.parts:
        tail = _obj_faces(folder, part)
        for frame in range(clip.num_frames):
            (folder / f"{part.name}_{frame + 1:04d}.obj").write_text(_obj_points(part, frame) + tail, encoding="ascii")


def write_ply_sequence(folder: Path, clip: Clip) -> None:
    """``NAME_0001.ply`` … of every part: binary, positions in float64, normals."""
    for part in clip.parts:
        num_faces, num_vertices = len(part.faces), part.pos.shape[1]
        header = "\n".join(
            [
                "ply",
                "format binary_little_endian 1.0",
                f"element vertex {num_vertices}",
                *(f"property double {axis}" for axis in "xyz"),
                *(f"property float n{axis}" for axis in "xyz"),
                f"element face {num_faces}",
                "property list uchar int vertex_indices",
                "end_header\n",
            ]
        ).encode()
        faces = np.empty(num_faces, np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
        faces["count"], faces["corners"] = 3, part.faces
        vertices = np.empty(num_vertices, np.dtype([("pos", "<f8", 3), ("normal", "<f4", 3)]))
        for frame in range(clip.num_frames):
            vertices["pos"], vertices["normal"] = part.pos[frame], part.normals(frame)
            (folder / f"{part.name}_{frame + 1:04d}.ply").write_bytes(header + vertices.tobytes() + faces.tobytes())


def write_point_cache(folder: Path, clip: Clip) -> None:
    """``NAME.obj``, the first frame, and ``NAME.pc2``, all frames in float32, of every part; images as with OBJ files."""
    for part in clip.parts:
        (folder / f"{part.name}.obj").write_text(_obj_points(part, 0) + _obj_faces(folder, part), encoding="ascii")
        # Version, points, first frame, frames from one sample to the next, samples.
        header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, part.pos.shape[1], 0.0, 1.0, clip.num_frames)
        (folder / f"{part.name}.pc2").write_bytes(header + np.ascontiguousarray(part.pos, "<f4").tobytes())


def write_mdd(folder: Path, clip: Clip) -> None:
    """The same as ``NAME.mdd``: numbers begin with their largest byte, and every frame has a time [s]."""
    times = np.arange(clip.num_frames) / clip.fps
    for part in clip.parts:
        (folder / f"{part.name}.obj").write_text(_obj_points(part, 0) + _obj_faces(folder, part), encoding="ascii")
        header = struct.pack(">ii", clip.num_frames, part.pos.shape[1])
        content = (times.astype(">f4").tobytes(), np.ascontiguousarray(part.pos, ">f4").tobytes())
        (folder / f"{part.name}.mdd").write_bytes(header + b"".join(content))


#: Where the head of a point cache says how many frames there are.
_SAMPLES = 28


class PointCacheFiles:
    """The point caches of :func:`write_point_cache`, open for further frames of a rollout that is being made.

    Frames are written before the head of a file counts them: whoever opens it meanwhile, as Blender does, finds whole ones.

    Args:
        data: what they were written from into ``folder``, by :func:`clip_of` without a thickness.
    """

    def __init__(self, folder: Path, data: RolloutData) -> None:
        clip = clip_of(data)
        self.num_frames, self._origin = clip.num_frames, clip.origin
        self._vertices = [piece.vertices for piece in pieces_of(data)]
        self._kinds = data.cloth_pos.dtype, data.body_pos.dtype
        self._is_far = max(_farthest(part.pos) for part in clip.parts) > _FAR
        self._files = [open(folder / f"{part.name}.pc2", "r+b") for part in clip.parts]

    def append(self, cloth_pos: np.ndarray, body_pos: np.ndarray) -> bool:
        """Write one frame, positions (V, 3) and (W, 3) [m] as the rollout's file is given them.

        Returns:
            Whether the files hold it. Not one that is not finite, nor the first that lies so far away that all frames are
            to be written from an origin of their own.

        Raises:
            OSError: the disk refuses; names the file.
        """
        cloth, body = (np.asarray(pos, kind) for pos, kind in zip((cloth_pos, body_pos), self._kinds, strict=True))
        parts = [cloth[vertices] for vertices in self._vertices] + [body] * bool(len(body))
        if not all(np.isfinite(pos).all() for pos in parts) or (max(map(_farthest, parts)) > _FAR and not self._is_far):
            return False
        for file, pos in zip(self._files, parts, strict=True):
            _put(file, np.ascontiguousarray(pos.astype(np.float64) - self._origin, "<f4").tobytes())
        self.num_frames += 1
        for file in self._files:
            _put(file, struct.pack("<i", self.num_frames), _SAMPLES)
        return True

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()


def _put(file: BinaryIO, content: bytes, place: int | None = None) -> None:
    """Write at ``place``, or behind the end; it is with the system then."""
    try:
        file.seek(0, os.SEEK_END) if place is None else file.seek(place)
        file.write(content)
        file.flush()
    except OSError as error:
        raise OSError(error.errno, error.strerror, file.name) from error


def _farthest(pos: np.ndarray) -> float:
    """Largest coordinate [m]."""
    return float(np.abs(pos).max(initial=0.0))


def _obj_points(part: ClipPart, frame: int) -> str:
    lines = obj_points(part.name, part.pos[frame], part.normals(frame))
    return lines if part.texture is None else f"mtllib {part.name}.mtl\n{lines}"


def _obj_faces(folder: Path, part: ClipPart) -> str:
    """Lines of a part's faces; of one with an image, that and the material with it are written into ``folder``."""
    lines = obj_faces(part.faces, part.faces, part.uv, part.uv_faces)
    if part.texture is None:
        return lines
    image = f"{part.name}{part.texture.suffix}"
    (folder / image).write_bytes(part.texture.content)
    material = f"newmtl {part.name}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {image}\n"
    (folder / f"{part.name}.mtl").write_text(material, encoding="ascii")
    return f"usemtl {part.name}\n{lines}"


#: Farther from the origin than this [m] float32, which most formats hold, is no longer good to 2 µm.
_FAR = 32.0
PARTS = ("cloth", "body")


@dataclass(frozen=True)
class ClipPart:
    """One moving mesh."""

    name: str
    pos: np.ndarray  # (T, V, 3) float64 m, from the clip's origin, its axis up
    faces: np.ndarray  # (F, 3)
    colour: tuple[float, float, float]  # sRGB, 0 to 1
    uv: np.ndarray | None = None  # (U, 2)
    uv_faces: np.ndarray | None = None  # (F, 3), into uv
    texture: Texture | None = None
    roughness: float = 0.9  # 0 to 1
    layers: np.ndarray | None = None  # (V, 2) m, distances of both sides of the shell that it is to be; None: it stays a sheet

    def velocities(self, frame: int, fps: float) -> np.ndarray:
        """(V, 3) m/s of one frame: central differences, one-sided in the first and the last."""
        before, after = max(frame - 1, 0), min(frame + 1, len(self.pos) - 1)
        return (self.pos[after] - self.pos[before]) * (fps / max(after - before, 1))

    def normals(self, frame: int) -> np.ndarray:
        """Unit normals (V, 3) of one frame; of vertices without a face, or with faces of no area, any."""
        found = np.zeros((self.pos.shape[1], 3))
        of_faces = corner_normals(self.pos[frame], self.faces, self.faces)
        found[: len(of_faces)] = of_faces
        found[np.linalg.norm(found, axis=1) < 0.5] = [0.0, 1.0, 0.0]
        return found


@dataclass(frozen=True)
class Clip:
    """Meshes that move together."""

    parts: tuple[ClipPart, ...]
    fps: float
    origin: np.ndarray  # (3,) m, whole metres; zero for motions near the world's origin

    @property
    def num_frames(self) -> int:
        return len(self.parts[0].pos)


def clip_of(
    data: RolloutData,
    parts: Sequence[str] = PARTS,
    num_frames: int | None = None,
    up: str = "y",
    textures: Mapping[str, Texture] | None = None,
    layers: np.ndarray | None = None,
) -> Clip:
    """A rollout as a clip: the cloth, one part a garment of an outfit, and the body.

    Args:
        parts: of :data:`PARTS`; a body without vertices is left out.
        num_frames: the first so many; None: all.
        up: ``y`` as in the rollout, or ``z``: turned by 90° about x.
        textures: images of garments that have texture coordinates, by the garment's name.
        layers: of :func:`hood.media.pieces.layer_distances`: the cloth is closed shells
            (:class:`hood.mesh.editing.subdivision.Extrusion`); None: sheets, with the rollout's vertices and faces.

    Raises:
        ValueError: nothing is left to export, or a position is not finite.
    """
    count = len(data.time) if num_frames is None else min(num_frames, len(data.time))
    dt = float(data.attributes.get("dt", 0.0))
    if not dt > 0:
        raise ValueError(f"dt is {dt} s; the file does not say how long a frame takes")
    meshes = []
    if "cloth" in parts:
        meshes += _cloth(data, data.cloth_pos[:count], textures or {}, layers)
    if "body" in parts and data.body_pos.shape[1]:
        meshes.append(ClipPart("body", data.body_pos[:count], data.body_faces, BODY_COLOR))
    if not meshes:
        raise ValueError("there is no body in it, and the cloth is not asked for; nothing is left to export")
    for mesh in meshes:
        broken = ~np.isfinite(mesh.pos).all(axis=(1, 2))
        if broken.any():
            frame = int(broken.argmax())
            raise ValueError(f"{mesh.name} has no finite position in frame {frame}; give num_frames={frame} or less")
    farthest = max(_farthest(mesh.pos) for mesh in meshes)
    origin = np.round(meshes[0].pos[0].astype(np.float64).mean(axis=0)) if farthest > _FAR else np.zeros(3)
    moved = (np.asarray(mesh.pos, np.float64) - origin for mesh in meshes)
    turned = (replace(mesh, pos=_upright(pos, up)) for mesh, pos in zip(meshes, moved, strict=True))
    return Clip(tuple(map(_shell, turned)), 1.0 / dt, _upright(origin, up))


def _cloth(data: RolloutData, pos: np.ndarray, textures: Mapping[str, Texture], layers: np.ndarray | None) -> list[ClipPart]:
    """One part a garment where the file says which vertex belongs to which; it looks like the fabric of most of it."""
    found, (looks, look_of) = [], looks_of(data)
    for piece in pieces_of(data):
        number = np.full(pos.shape[1], -1)
        number[piece.vertices] = np.arange(len(piece.vertices))
        faces, texture = number[data.cloth_faces[piece.faces]], textures.get(piece.name)
        own = pos[:, piece.vertices]
        look = looks[int(np.bincount(look_of[piece.vertices], minlength=1).argmax())]
        thick = None if layers is None else layers[piece.vertices]
        found.append(ClipPart(piece.name, own, faces, look.colour, piece.uv, piece.uv_faces, texture, look.roughness, thick))
    return found


def _shell(part: ClipPart) -> ClipPart:
    """A sheet with its thickness; what is none as it is."""
    if part.layers is None:
        return part
    shell = Extrusion(part.faces, part.pos.shape[1], kept=(part.layers[part.faces] == 0.0).all(axis=(1, 2)))
    pos = np.stack([shell.positions(pos, part.layers) for pos in part.pos])
    uv_faces = None if part.uv_faces is None else part.uv_faces.reshape(-1)[shell.source]
    return replace(part, pos=pos, faces=shell.faces, uv_faces=uv_faces, layers=None)


def _upright(pos: np.ndarray, up: str) -> np.ndarray:
    """``pos`` (…, 3) with the wanted axis up; a turn, no mirror image."""
    return pos if up == "y" else np.stack([pos[..., 0], -pos[..., 2], pos[..., 1]], axis=-1)


def corner_normals(pos: np.ndarray, faces: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Unit normals (M, 3), one per number in ``corners`` (F, 3): area-weighted over the faces that share it."""
    a, b, c = (pos[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    total = np.zeros((int(corners.max(initial=-1)) + 1, 3))
    for k in range(3):
        np.add.at(total, corners[:, k], cross)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
