"""Meshes for other programs: OBJ files with the texture coordinates and hard edges of the garment, a mesh file a frame
(OBJ, PLY), and one mesh with a point cache (OBJ and PC2)."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.garment.garment import Garment
from hood.media.exports.clip import Clip, ClipPart, corner_normals


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
