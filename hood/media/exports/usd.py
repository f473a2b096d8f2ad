"""USD: one prim a part, positions and normals as time samples, and images beside the file."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np

from hood.media.exports.clip import Clip, ClipPart


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
        _write(path, clip, up, Path(name or path.name).stem)
    except Tf.ErrorException as error:
        raise OSError(errno.EIO, "cannot be written; is the folder writable, is there space?", str(path)) from error


def image_name(stem: str, part: ClipPart) -> str:
    """Name of the image of a part beside the file ``stem.usd``."""
    assert part.texture is not None
    return f"{stem}_{part.name}_texture{part.texture.suffix}"


def _write(path: Path, clip: Clip, up: str, name: str) -> None:
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
        _add(UsdGeom.Mesh.Define(stage, f"/rollout/{part.name}"), part, UsdGeom, Vt)
    for part in clip.parts:
        if part.texture is not None:
            _lay_on(stage, clip, part.name, image_name(name, part))
    stage.GetRootLayer().Save()


def _add(mesh: Any, part: ClipPart, geom: Any, vt: Any) -> None:
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
    for frame, pos in enumerate(part.pos):
        here = np.ascontiguousarray(pos, np.float32)
        points.Set(vt.Vec3fArray.FromNumpy(here), frame)
        normals.Set(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(part.normals(frame), np.float32)), frame)
        extent.Set(vt.Vec3fArray.FromNumpy(np.stack([here.min(axis=0), here.max(axis=0)])), frame)


def _lay_on(stage: Any, clip: Clip, part: str, image: str) -> None:
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
    surface.CreateInput("roughness", kinds.Float).Set(0.9)
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(texture.CreateOutput("rgb", kinds.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    mesh = stage.GetPrimAtPath(f"/rollout/{part}")
    UsdShade.MaterialBindingAPI.Apply(mesh).Bind(material)
