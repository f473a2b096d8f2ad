"""Scene files, one for all frames.

glTF 2.0, binary: every frame a morph target, and an animation that goes from one to the next.

USD: one prim a part; positions, normals and velocities as time samples; images beside the file.
"""

from __future__ import annotations

import errno
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.formats.raw_mesh import Texture
from hood.media.exports.sequences import Clip, ClipPart
from hood.media.pieces import split_seams

#: Larger files [bytes] are refused: browsers and game engines keep all morph targets in memory.
_LARGEST = 256 * 2**20

_FLOAT, _UNSIGNED = 5126, 5125


def estimated_size(clip: Clip, velocities: bool = False) -> int:
    """Bytes of the file, about."""
    weights = 4 * clip.num_frames**2 * len(clip.parts)
    images = sum(len(texture.content) for texture in _images(clip))
    row = 36 if velocities else 24
    return images + weights + sum(row * clip.num_frames * len(_corners(part)[0]) for part in clip.parts)


def gltf_bytes(clip: Clip, velocities: bool = False) -> bytes:
    """The file. Axes, units and origin: y up, metres; the origin is the translation of the nodes.

    Args:
        velocities: of every vertex [m/s] as well, the attribute ``_VELOCITY`` with its morph targets: like positions, those of
            a frame are the attribute and the frame's target together.

    Raises:
        ValueError: above :data:`_LARGEST`.
    """
    size = estimated_size(clip, velocities)
    if size > _LARGEST:
        raise ValueError(
            f"as glb it would have {size / 2**20:.0f} MiB, more than the {_LARGEST // 2**20} that programs open with ease; "
            "give num_frames=, parts=[cloth], or format=usd"
        )
    file = _Buffers()
    times = file.add(np.arange(clip.num_frames, dtype=np.float32) / np.float32(clip.fps), "SCALAR", bounds=True)
    # One target a frame; between two frames the weights, and so the positions, go straight from one to the other.
    weights = np.eye(clip.num_frames, dtype=np.float32)[:, 1:].reshape(-1)
    shares = file.add(weights, "SCALAR") if clip.num_frames > 1 else None
    nodes, meshes, materials, samplers, channels = [], [], [], list[dict[str, Any]](), list[dict[str, Any]]()
    images = _images(clip)
    for index, part in enumerate(clip.parts):
        meshes.append(_mesh(file, part, index, clip.fps if velocities else None))
        linear = [*(float(channel) ** 2.2 for channel in part.colour), 1.0]
        surface: dict[str, Any] = {"baseColorFactor": linear, "metallicFactor": 0.0, "roughnessFactor": part.roughness}
        if part.texture is not None:
            surface |= {"baseColorFactor": [1.0] * 4, "baseColorTexture": {"index": images.index(part.texture)}}
        materials.append({"name": part.name, "pbrMetallicRoughness": surface, "doubleSided": part.name != "body"})
        nodes.append({"name": part.name, "mesh": index, "translation": [float(value) for value in clip.origin]})
        if shares is not None:
            samplers.append({"input": times, "output": shares, "interpolation": "LINEAR"})
            channels.append({"sampler": index, "target": {"node": index, "path": "weights"}})
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "hood"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": materials,
        **_textures(file, images),
        "accessors": file.accessors,
        "bufferViews": file.views,
        "buffers": [{"byteLength": file.length}],
    }
    if channels:
        document["animations"] = [{"name": "rollout", "samplers": samplers, "channels": channels}]
    return _packed(json.dumps(document).encode(), b"".join(file.chunks))


def _mesh(file: _Buffers, part: ClipPart, material: int, fps: float | None) -> dict[str, Any]:
    """Of a rate ``fps`` with velocities."""
    corners, faces, uv = _corners(part)
    base, normals = part.pos[0][corners].astype(np.float32), part.normals(0)[corners].astype(np.float32)
    attributes = {"POSITION": file.add(base, "VEC3", bounds=True), "NORMAL": file.add(normals, "VEC3")}
    if uv is not None:
        turned = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)  # an image begins at its top here
        attributes["TEXCOORD_0"] = file.add(turned.astype(np.float32), "VEC2")
    targets: list[dict[str, int]] = []
    speed = None if fps is None else part.velocities(0, fps)[corners].astype(np.float32)
    if speed is not None:
        attributes["_VELOCITY"] = file.add(speed, "VEC3")
    for frame in range(1, len(part.pos)):
        moved = (part.pos[frame][corners] - base).astype(np.float32)
        turn = part.normals(frame)[corners].astype(np.float32) - normals
        targets.append({"POSITION": file.add(moved, "VEC3", bounds=True), "NORMAL": file.add(turn, "VEC3")})
        if fps is not None:
            targets[-1]["_VELOCITY"] = file.add(part.velocities(frame, fps)[corners].astype(np.float32) - speed, "VEC3")
    indices = file.add(faces.astype(np.uint32).reshape(-1), "SCALAR")
    primitive: dict[str, Any] = {"attributes": attributes, "indices": indices, "material": material}
    mesh: dict[str, Any] = {"name": part.name, "primitives": [primitive]}
    if targets:
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
    return mesh


def _corners(part: ClipPart) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertex of every point (N,), faces over points, and texture coordinates (N, 2): a vertex on a seam is several points."""
    if part.uv is None or part.uv_faces is None:
        return np.arange(part.pos.shape[1]), part.faces, None
    vertex, coordinate, faces = split_seams(part.faces, part.uv_faces)
    return vertex, faces, part.uv[coordinate]


def _images(clip: Clip) -> list[Texture]:
    """Every image once."""
    return list(dict.fromkeys(part.texture for part in clip.parts if part.texture is not None))


def _textures(file: _Buffers, images: list[Texture]) -> dict[str, Any]:
    """Tables of the document for images that repeat, in their order; nothing without images."""
    if not images:
        return {}
    views = [{"bufferView": file.add_bytes(image.content), "mimeType": image.kind} for image in images]
    # 10497: repeat; 9729 and 9987: between pixels, and between sizes of the image, linear.
    return {
        "images": views,
        "samplers": [{"wrapS": 10497, "wrapT": 10497, "magFilter": 9729, "minFilter": 9987}],
        "textures": [{"sampler": 0, "source": place} for place in range(len(images))],
    }


class _Buffers:
    """The binary part while it grows, and the tables that say where what is."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.length = 0

    def add(self, values: np.ndarray, kind: str, bounds: bool = False) -> int:
        """Number of the accessor of ``values``, float32 or uint32."""
        view = self.add_bytes(values.tobytes())
        component = _FLOAT if values.dtype == np.float32 else _UNSIGNED
        accessor: dict[str, Any] = {"bufferView": view, "componentType": component, "count": len(values)}
        accessor["type"] = kind
        if bounds:
            low, high = (np.atleast_1d(edge(values, axis=0)) for edge in (np.min, np.max))
            accessor["min"], accessor["max"] = [float(v) for v in low], [float(v) for v in high]
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_bytes(self, content: bytes) -> int:
        """Number of the view of ``content``; the next one begins at a multiple of four."""
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": len(content)})
        padded = content + b"\0" * (-len(content) % 4)
        self.chunks.append(padded)
        self.length += len(padded)
        return len(self.views) - 1


def _packed(document: bytes, binary: bytes) -> bytes:
    document += b" " * (-len(document) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(document) + 8 + len(binary)
    head = struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(document), b"JSON")
    return head + document + struct.pack("<I4s", len(binary), b"BIN\0") + binary


# ---- USD ---------------------------------------------------------------------------------------------------------------------


def write_usd(path: Path, clip: Clip, up: str, name: str | None = None) -> None:
    """Write the clip as a stage: metres, one time code a frame from 0 on, ``up`` axis ``y`` or ``z``.

    Args:
        path: ends in ``.usd``, ``.usdc`` (binary) or ``.usda`` (text).
        name: what the file will be called; None: as in ``path``. It names images by :func:`image_name`, which are not written.

    Raises:
        OSError: it cannot be written.
    """
    from pxr import Tf

    try:
        _write_stage(path, clip, up, Path(name or path.name).stem)
    except Tf.ErrorException as error:
        raise OSError(errno.EIO, "cannot be written; is the folder writable, is there space?", str(path)) from error


def image_name(stem: str, part: ClipPart) -> str:
    """Name of the image of a part beside the file ``stem.usd``."""
    assert part.texture is not None
    return f"{stem}_{part.name}_texture{part.texture.suffix}"


def _write_stage(path: Path, clip: Clip, up: str, name: str) -> None:
    from pxr import Gf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y if up == "y" else UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(clip.fps)
    stage.SetFramesPerSecond(clip.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(clip.num_frames - 1)
    root = UsdGeom.Xform.Define(stage, "/rollout")
    stage.SetDefaultPrim(root.GetPrim())
    if clip.origin.any():
        root.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*map(float, clip.origin)))
    for part in clip.parts:
        _add_prim(UsdGeom.Mesh.Define(stage, f"/rollout/{part.name}"), part, clip.fps, UsdGeom, Vt)
    for part in clip.parts:
        if part.texture is not None:
            _bind_image(stage, clip, part.name, image_name(name, part))
    stage.GetRootLayer().Save()


def _add_prim(mesh: Any, part: ClipPart, fps: float, geom: Any, vt: Any) -> None:
    """Velocities are per second, not per time code, as the schema says; a still mesh has none."""
    mesh.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(part.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(np.ascontiguousarray(part.faces.reshape(-1), np.int32)))
    mesh.CreateSubdivisionSchemeAttr(geom.Tokens.none)
    mesh.CreateDoubleSidedAttr(part.name != "body")
    linear = np.array([part.colour], np.float32) ** np.float32(2.2)
    mesh.CreateDisplayColorAttr(vt.Vec3fArray.FromNumpy(linear))
    if part.uv is not None and part.uv_faces is not None:
        from pxr import Sdf

        texture = geom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, geom.Tokens.faceVarying)
        texture.Set(vt.Vec2fArray.FromNumpy(np.ascontiguousarray(part.uv, np.float32)))
        texture.SetIndices(vt.IntArray.FromNumpy(np.ascontiguousarray(part.uv_faces.reshape(-1), np.int32)))
    points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
    mesh.SetNormalsInterpolation(geom.Tokens.vertex)
    velocities = mesh.CreateVelocitiesAttr() if len(part.pos) > 1 else None
    for frame, pos in enumerate(part.pos):
        here = np.ascontiguousarray(pos, np.float32)
        points.Set(vt.Vec3fArray.FromNumpy(here), frame)
        normals.Set(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(part.normals(frame), np.float32)), frame)
        if velocities is not None:
            velocities.Set(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(part.velocities(frame, fps), np.float32)), frame)
        extent.Set(vt.Vec3fArray.FromNumpy(np.stack([here.min(axis=0), here.max(axis=0)])), frame)


def _bind_image(stage: Any, clip: Clip, part: str, image: str) -> None:
    """Bind a material with the image, which lies beside the stage, to the mesh of a part."""
    from pxr import Sdf, UsdShade

    folder = "materials"
    while folder in [other.name for other in clip.parts]:
        folder += "_"
    material = UsdShade.Material.Define(stage, f"/rollout/{folder}/{part}")
    path, kinds = material.GetPath(), Sdf.ValueTypeNames
    surface, reader, texture = (UsdShade.Shader.Define(stage, path.AppendChild(name)) for name in ("surface", "st", "image"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(f"./{image}")
    for axis in ("wrapS", "wrapT"):
        texture.CreateInput(axis, kinds.Token).Set("repeat")
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    texture.CreateInput("st", kinds.Float2).ConnectToSource(reader.CreateOutput("result", kinds.Float2))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", kinds.Float).Set(next(one.roughness for one in clip.parts if one.name == part))
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(texture.CreateOutput("rgb", kinds.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    mesh = stage.GetPrimAtPath(f"/rollout/{part}")
    UsdShade.MaterialBindingAPI.Apply(mesh).Bind(material)
