"""USD files (``.usd``, ``.usda``, ``.usdc``, ``.usdz``): the meshes of a stage in its world, still or moving, in metres, y up.

usd-core reads them; it is imported where a file is.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hood.assets.files.guarded import Refused, check_size, guarded, listed
from hood.assets.files.library import SIZE_LIMIT
from hood.assets.formats.raw_mesh import RawMesh, join_meshes, named_polygons, unit_colours
from hood.mesh.editing.quality import triangulate

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
#: Why there may be none: it is installed with this package where it has a wheel.
NO_USD = "needs usd-core, which has no wheel for this Python and machine"


def has_usd() -> bool:
    """Whether USD files can be read and written here."""
    return importlib.util.find_spec("pxr") is not None


class MovingMeshes(NamedTuple):
    """The meshes of a stage as one, frame by frame."""

    verts: np.ndarray  # (T, W, 3) m
    faces: np.ndarray  # (G, 3)


def read_usd(path: Path) -> RawMesh:
    """Every visible mesh of a stage, at its first time code, with UVs, normals and colours; polygons have the names of their
    prims, materials and subsets. Skinned meshes are in the pose of that time code.

    Raises:
        ValueError: usd-core is missing, no USD file, or no mesh; names the file and the fix.
    """

    def read(stage: Any) -> RawMesh:
        start, _ = _span(stage)
        frame = _Frame(stage, start)
        found = [(mesh, _raw(mesh, frame)) for mesh in _meshes(stage)]
        found = [(mesh, raw) for mesh, raw in found if len(raw.counts)]
        if not found:
            raise Refused("the stage has no visible mesh with faces; export the garment's mesh with it")
        joined = join_meshes([raw for _, raw in found])
        combinations, of_polygons = list[tuple[str, ...]](), []
        for mesh, raw in found:
            own, kind = _names(mesh, len(raw.counts))
            of_polygons.append(kind + len(combinations))
            combinations += own
        joined.panels, notes = named_polygons(combinations, np.concatenate(of_polygons))
        joined.notes += notes
        return joined

    return _opened(path, read)


def read_usd_animation(path: Path, fps: float, parts: Sequence[str] = ()) -> MovingMeshes:
    """All visible meshes of a stage, evaluated at k / fps from its first time code to its last; a still one gives one frame.

    Skeletons are played: usd-core bakes them into points.

    Args:
        parts: names or paths of the prims that count; those of a prim above a mesh count too; empty: all.

    Raises:
        ValueError: usd-core is missing, no USD file, no mesh, an unknown part, points that become more or fewer, or too large;
            names the file and the fix.
    """
    return _opened(path, lambda stage: _evaluate(stage, fps, parts))


def moves(path: Path) -> bool:
    """Whether anything in a file is time-sampled."""
    return bool(_opened(path, lambda stage: _span(stage)[1] > _span(stage)[0]))


def _opened(path: Path, read: Any) -> Any:
    """What ``read`` makes of the stage, opened and with its skeletons baked in memory."""
    check_size(path, SIZE_LIMIT)
    if not has_usd():
        raise ValueError(f"{path}: reading USD {NO_USD}; export a garment as OBJ, a moving body as GLB")
    return guarded(path, "USD file", lambda: read(_stage(path)))


def _stage(path: Path) -> Any:
    from pxr import Pcp, Tf, Usd, UsdSkel, UsdUtils

    _quiet = UsdUtils.CoalescingDiagnosticDelegate()  # what it would print is said below
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise Refused("not a readable USD file; write or download it again") from error
    lost = [str(error) for error in stage.GetCompositionErrors() if isinstance(error, Pcp.ErrorInvalidAssetPath)]
    if lost:
        names = sorted({Path(said.split("@")[1]).name for said in lost})
        raise Refused(f"refers to {listed(names)}, which cannot be read; put it beside, or export one flattened file")
    if any(prim.IsA(UsdSkel.Root) for prim in stage.Traverse()):
        stage.SetEditTarget(stage.GetSessionLayer())  # the file stays as it is
        UsdSkel.BakeSkinning(stage.Traverse())
    return stage


def _span(stage: Any) -> tuple[float, float]:
    """The first and the last time code: those that the stage says, else those of its samples; equal where nothing moves."""
    times = [time for prim in stage.TraverseAll() for attribute in prim.GetAttributes() for time in attribute.GetTimeSamples()]
    if not times or min(times) == max(times):
        return (times[0],) * 2 if times else (0.0, 0.0)
    if stage.HasAuthoredTimeCodeRange() and stage.GetEndTimeCode() > stage.GetStartTimeCode():
        return stage.GetStartTimeCode(), stage.GetEndTimeCode()
    return min(times), max(times)


class _Frame:
    """Where the prims of a stage are at a time code, in metres, y up."""

    def __init__(self, stage: Any, time: float) -> None:
        from pxr import UsdGeom

        self.time, self._cache = time, UsdGeom.XformCache(time)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # rows: where x, y and z go
        self._axes = UsdGeom.GetStageMetersPerUnit(stage) * (turn if UsdGeom.GetStageUpAxis(stage) == "Z" else np.eye(3))

    def matrix(self, mesh: Any) -> np.ndarray:
        """(4, 3): rows of points with 1 behind them times it are in the world."""
        return np.array(self._cache.GetLocalToWorldTransform(mesh.GetPrim()))[:, :3] @ self._axes

    def points(self, mesh: Any) -> np.ndarray:
        """(V, 3) m."""
        own, matrix = np.array(mesh.GetPointsAttr().Get(self.time), np.float64).reshape(-1, 3), self.matrix(mesh)
        return own @ matrix[:3] + matrix[3]

    def corners(self, mesh: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertex of every corner (N,), corners of every polygon (P,), and (N,) the place of each corner in the file: faces
        look outwards, whatever is left-handed or mirrored there."""
        counts, corners = (
            np.array(attribute.Get(self.time), np.int64).reshape(-1)
            for attribute in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
        )
        if (counts < 0).any() or counts.sum() != len(corners):
            raise Refused(f"{mesh.GetPath()} has {len(corners)} corners for polygons of {counts.sum()}; export it again")
        place, first = np.arange(len(corners)), np.repeat(np.cumsum(counts) - counts, counts)
        if (mesh.GetOrientationAttr().Get() == "leftHanded") != (np.linalg.det(self.matrix(mesh)[:3]) < 0):
            place = first + np.repeat(counts, counts) - 1 - (place - first)
        return corners[place], counts, place


def _meshes(stage: Any, parts: Sequence[str] = ()) -> Iterator[Any]:
    """Visible meshes that are no stand-ins; of them those within ``parts``."""
    from pxr import Usd, UsdGeom

    names = set()
    for prim in stage.Traverse(Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)):
        shown = prim.IsA(UsdGeom.Mesh) and UsdGeom.Imageable(prim).ComputeVisibility() != UsdGeom.Tokens.invisible
        if not shown or UsdGeom.Imageable(prim).ComputePurpose() in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide):
            continue
        path = str(prim.GetPath())
        own = {path, *path.split("/")[1:]}
        names.add(prim.GetName())
        if not parts or own & set(parts):
            yield UsdGeom.Mesh(prim)
        names |= own & set(parts)
    missing = set(parts) - names
    if missing:
        raise Refused(f"no part {sorted(missing)[0]!r}; it has {listed(sorted(names), 12)}")


def _evaluate(stage: Any, fps: float, parts: Sequence[str]) -> MovingMeshes:
    start, stop = _span(stage)
    rate = stage.GetTimeCodesPerSecond()
    times = start + np.arange(int((stop - start) / rate * fps + 1e-6) + 1) * rate / fps
    meshes, first = list(_meshes(stage, parts)), _Frame(stage, start)
    rows = [(mesh, first.points(mesh), *first.corners(mesh)[:2]) for mesh in meshes]
    rows = [row for row in rows if len(row[3])]
    if not rows:
        raise Refused("the stage has no visible mesh with faces; export the body's mesh with it")
    size = sum(len(points) for _, points, *_ in rows)
    if len(times) * size * 24 > SIZE_LIMIT:
        raise Refused(f"{len(times)} frames of {size} vertices are too many; lower fps or shorten the animation")
    faces, offset = [], 0
    for mesh, points, corners, counts in rows:
        if len(corners) and not 0 <= corners.min() <= corners.max() < len(points):
            raise Refused(f"{mesh.GetPath()} refers to vertices beyond its {len(points)}; the file is damaged")
        if (counts < 3).any():
            raise Refused(f"{mesh.GetPath()} has a face of {counts.min()} corners; remove it")
        faces.append(corners[triangulate(points, corners, counts)] + offset)
        offset += len(points)
    verts = np.empty((len(times), size, 3))
    for place, time in enumerate(times):
        frame = _Frame(stage, float(time))
        offset = 0
        for mesh, points, *_ in rows:
            now, count = frame.points(mesh), len(points)
            if len(now) != count:
                path = mesh.GetPath()
                raise Refused(f"{path} has {count} points at first and {len(now)} at time code {time:g}; a body keeps them")
            verts[place, offset : offset + count] = now
            offset += count
    return MovingMeshes(verts, np.concatenate(faces))


def _raw(mesh: Any, frame: _Frame) -> RawMesh:
    """One mesh with what its points and corners have."""
    from pxr import UsdGeom

    corners, counts, place = frame.corners(mesh)
    raw = RawMesh(frame.points(mesh), corners, counts)
    variables = UsdGeom.PrimvarsAPI(mesh)
    maps = [one for one in variables.GetPrimvars() if str(one.GetTypeName()).startswith("texCoord2") and one.HasValue()]
    chosen = next((one for one in maps if one.GetPrimvarName() == "st"), maps[0] if maps else None)
    if chosen is not None:
        raw.uv, raw.uv_corners = _table(chosen, 2, raw, place, frame.time)
    normals = variables.GetPrimvar("normals")
    if normals and normals.HasValue():
        raw.normals, raw.normal_corners = _table(normals, 3, raw, place, frame.time)
    elif (values := mesh.GetNormalsAttr().Get(frame.time)) is not None and len(values):
        kind = str(mesh.GetNormalsInterpolation())
        raw.normals, raw.normal_corners = _spread(np.array(values, np.float64), None, kind, raw, place)
    colour = mesh.GetDisplayColorPrimvar()
    if colour and colour.HasValue() and colour.GetInterpolation() in ("vertex", "varying"):
        values = np.array(colour.ComputeFlattened(frame.time), np.float64).reshape(-1, 3)
        raw.colours = unit_colours(np.clip(values, 0.0, 1.0) ** (1.0 / 2.2)) if len(values) == len(raw.pos) else None
    return raw


def _table(variable: Any, width: int, raw: RawMesh, place: np.ndarray, time: float) -> Any:
    values = np.array(variable.Get(time), np.float64).reshape(-1, width)
    indices = np.array(variable.GetIndices(time), np.int64) if variable.IsIndexed() else None
    return _spread(values, indices, str(variable.GetInterpolation()), raw, place)


def _spread(
    values: np.ndarray, indices: np.ndarray | None, kind: str, raw: RawMesh, place: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """A table and the row of it that every corner has; nothing where it is of other elements, or does not fit."""
    number = np.arange(len(values)) if indices is None else indices
    of_corners = {"faceVarying": place, "vertex": raw.corners, "varying": raw.corners}.get(kind)
    if of_corners is None or not len(of_corners) or of_corners.min() < 0 or of_corners.max() >= len(number):
        return None, None
    return values, number[of_corners]


def _names(mesh: Any, num_polygons: int) -> tuple[list[tuple[str, ...]], np.ndarray]:
    """Names that polygons have, those of a mesh, of the prims above it, and of a material or subset, and (P,) which of them
    each has."""
    from pxr import UsdGeom, UsdShade

    path, kind = tuple(str(mesh.GetPath()).split("/")[1:]), np.zeros(num_polygons, np.int64)
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    combinations = [(*path, material.GetPrim().GetName()) if material else path]
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(mesh)):
        if subset.GetElementTypeAttr().Get() == "face":
            own = np.array(subset.GetIndicesAttr().Get(), np.int64).reshape(-1)
            kind[own[(own >= 0) & (own < num_polygons)]] = len(combinations)
            combinations.append((*path, subset.GetPrim().GetName()))
    return combinations, kind
