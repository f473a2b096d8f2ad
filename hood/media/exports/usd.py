"""USD: one prim a part, positions and normals as time samples."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import numpy as np

from hood.media.exports.clip import Clip, Part


def write_usd(path: Path, clip: Clip, up: str) -> None:
    """Write the clip as a stage: metres, one time code a frame from 0 on, ``up`` axis ``y`` or ``z``.

    Args:
        path: ends in ``.usd``, ``.usdc`` (binary) or ``.usda`` (text).

    Raises:
        OSError: it cannot be written.
    """
    from pxr import Tf

    try:
        _write(path, clip, up)
    except Tf.ErrorException as error:
        raise OSError(errno.EIO, "cannot be written; is the folder writable, is there space?", str(path)) from error


def _write(path: Path, clip: Clip, up: str) -> None:
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
    stage.GetRootLayer().Save()


def _add(mesh: Any, part: Part, geom: Any, vt: Any) -> None:
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
