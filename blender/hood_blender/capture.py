"""The body frame by frame, and the garments at the first frame, as Blender evaluates them, in metres with y up."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import bpy
import numpy as np

from .axes import to_metres
from .fault import BakeError
from .lookup import curves_of
from .meshes import Exported, export_mesh
from .stack import CACHE, cut_of, own_keys, switched_off

#: Modifiers without which a garment is not whole.
_BUILDING = {"MIRROR": "Mirror", "ARRAY": "Array", "BOOLEAN": "Boolean", "SKIN": "Skin", "SCREW": "Screw", "BUILD": "Build"}
_MESHES = {"MESH", "CURVE", "SURFACE", "FONT", "META"}


class BodyPose(NamedTuple):
    """The body at a moment."""

    pos: np.ndarray  # (W, 3) m, y up
    faces: np.ndarray  # (G, 3)
    loops: int  # corners of all polygons


def evaluated(scene: Any, layer: str, frame: float | None = None) -> Any:
    """The depsgraph of a scene at a frame; None: as it is."""
    if frame is not None:
        whole = int(np.floor(frame))
        scene.frame_set(whole, subframe=frame - whole)
    view = scene.view_layers.get(layer) or scene.view_layers[0]
    view.update()
    return view.depsgraph


def body_pose(depsgraph: Any, body: Any, scale: float, origin: np.ndarray) -> BodyPose:
    """The body as it is evaluated, with its modifiers and instances.

    Raises:
        BakeError: it has no faces, or is hidden.
    """
    points, triangles, start, loops = [], [], 0, 0
    for mesh, matrix in _meshes(depsgraph, body):
        pos, faces = _arrays(mesh)
        points.append(to_metres(pos, matrix, scale, origin))
        triangles.append(faces + start)
        start, loops = start + len(pos), loops + len(mesh.loops)
    faces = np.concatenate(triangles) if triangles else np.zeros((0, 3), int)
    if not len(faces):
        raise BakeError(f"body {body.name} has no faces, or is hidden; show it in this view layer, or choose another object")
    pos = np.concatenate(points)
    if not np.isfinite(pos).all():
        vertex = int((~np.isfinite(pos).all(axis=1)).argmax())
        raise BakeError(f"body {body.name}: vertex {vertex} has no finite position in frame {depsgraph.scene.frame_current}")
    return BodyPose(pos, faces, loops)


def _meshes(depsgraph: Any, body: Any) -> Iterator[tuple[Any, np.ndarray]]:
    """Evaluated meshes of an object and of its instances, with their matrices into the world."""
    for instance in depsgraph.object_instances:
        one = instance.object
        owner = instance.parent if instance.is_instance else one
        if owner is None or owner.original != body or one.type not in _MESHES:
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        mesh = one.to_mesh()
        if mesh is not None:
            yield mesh, matrix
            one.to_mesh_clear()


def _arrays(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) and triangles (F, 3) of a mesh of Blender."""
    pos = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", pos)
    mesh.calc_loop_triangles()
    faces = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", faces)
    return pos.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int64)


def check_same(body: Any, first: BodyPose, pose: BodyPose, frame: float) -> None:
    """Refuse a body whose mesh changes while it moves.

    Raises:
        BakeError: see there.
    """
    if len(pose.pos) != len(first.pos) or pose.loops != first.loops:
        names = ", ".join(modifier.name for modifier in getattr(body, "modifiers", ())) or "none"
        raise BakeError(
            f"body {body.name}: {len(pose.pos)} vertices in frame {frame:g}, {len(first.pos)} at first; a body keeps its mesh: "
            f"switch off the modifier that changes it ({names})"
        )


def movement_key(scene: Any) -> list[Any]:
    """What keyframes say: all actions of the file, and frames that may have moved with them."""
    found: list[Any] = []
    for action in sorted(bpy.data.actions, key=lambda one: one.name_full):
        for curve in curves_of(action):
            if str(curve.data_path).startswith(f'key_blocks["{CACHE}_'):
                continue  # what an earlier bake has keyed
            points = np.empty(2 * len(curve.keyframe_points), np.float32)
            curve.keyframe_points.foreach_get("co", points)
            handles = np.empty(2 * len(curve.keyframe_points), np.float32)
            curve.keyframe_points.foreach_get("handle_left", handles)
            found.append([action.name_full, curve.data_path, curve.array_index, points.tolist(), handles.tolist()])
    return found


def check_garment(garment: Any) -> None:
    """Refuse an object that cannot be simulated as it is.

    Raises:
        BakeError: says what to do.
    """
    name = garment.name
    if garment.type != "MESH":
        raise BakeError(f"{name}: is a {garment.type.lower()}, a garment is a mesh; choose Object > Convert > Mesh", name)
    if garment.library is not None or (garment.data.library is not None and garment.override_library is None):
        raise BakeError(
            f"{name}: is linked from {_library(garment)}; choose Object > Library Override > Make, or make it local", name
        )
    if garment.mode == "EDIT":
        raise BakeError(f"{name}: is in edit mode; leave it (Tab)", name)
    for modifier in list(garment.modifiers)[cut_of(garment) :]:
        if modifier.type in _BUILDING and modifier.show_viewport:
            kind = _BUILDING[modifier.type]
            raise BakeError(f"{name}: modifier {modifier.name} ({kind}) makes a part of the garment; apply it, then bake", name)
    if abs(np.linalg.det(np.array(garment.matrix_world)[:3, :3])) < 1e-18:
        raise BakeError(f"{name}: an axis is scaled to 0; give it a scale", name)


def _library(garment: Any) -> str:
    library = garment.library or garment.data.library
    return f"the packed library {library.name}" if library.packed_file else str(library.filepath)


def garment_mesh(scene: Any, layer: str, garment: Any, scale: float, origin: np.ndarray, sew: float) -> Exported:
    """The garment before its cache, at the frame that is set: with the modifiers that deform it before anything else does.

    Raises:
        BakeError: no mesh that can be simulated.
    """
    check_garment(garment)
    cut, (modifiers, keys) = cut_of(garment), switched_off(garment)
    shown = [(modifier, modifier.show_viewport) for modifier in garment.modifiers]
    muted = [(key, key.mute) for key in [*own_keys(garment), *keys]]
    try:
        for place, (modifier, is_on) in enumerate(shown):
            modifier.show_viewport = place < cut and (is_on or modifier in modifiers)
        for key in own_keys(garment):
            key.mute = True
        for key in keys:
            key.mute = False
        one = garment.evaluated_get(evaluated(scene, layer))
        mesh = one.to_mesh()
        try:
            if len(mesh.vertices) != len(garment.data.vertices):
                raise BakeError(
                    f"{garment.name}: a modifier changes its {len(garment.data.vertices)} vertices; apply it", garment.name
                )
            pos, faces = _arrays(mesh)
            polygon, slot = np.empty(len(faces), np.int32), np.empty(len(mesh.polygons), np.int32)
            mesh.loop_triangles.foreach_get("polygon_index", polygon)
            mesh.polygons.foreach_get("material_index", slot)
            matrix = np.array(one.matrix_world, np.float64)
        finally:
            one.to_mesh_clear()
    finally:
        for modifier, is_on in shown:
            modifier.show_viewport = is_on
        for key, mute in muted:
            key.mute = mute
        evaluated(scene, layer)
    slot = np.clip(slot, 0, max(len(garment.material_slots) - 1, 0))
    slots = slot[polygon] if len(polygon) else np.zeros(0, np.int32)
    return export_mesh(garment.name, to_metres(pos, matrix, scale, origin), faces, slots, polygon, sew)


def weights_of(owner: Any, group: str, mesh: Any | None = None) -> np.ndarray:
    """(N,) weights of a vertex group; of an evaluated ``mesh`` where it is given.

    Raises:
        BakeError: there is no such group.
    """
    found = owner.vertex_groups.get(group) if hasattr(owner, "vertex_groups") else None
    if found is None:
        known = ", ".join(one.name for one in getattr(owner, "vertex_groups", ())) or "none"
        raise BakeError(f"{owner.name}: has no vertex group {group!r} (it has {known}); choose one of them", owner.name)
    vertices = (owner.data if mesh is None else mesh).vertices
    weights = np.zeros(len(vertices))
    for vertex in vertices:
        for one in vertex.groups:
            if one.group == found.index:
                weights[vertex.index] = one.weight
    return weights


def body_group(depsgraph: Any, body: Any, group: str) -> list[int]:
    """Vertices of the captured body in a vertex group of it (weight above a half).

    Raises:
        BakeError: no such group, or nothing in it.
    """
    start, found = 0, []
    for mesh, _ in _meshes(depsgraph, body):
        weights = weights_of(body, group, mesh)
        found += (np.flatnonzero(weights > 0.5) + start).tolist()
        start += len(mesh.vertices)
    if not found:
        raise BakeError(f"{body.name}: no vertex has a weight above 0.5 in the group {group!r}; paint it, or choose another")
    return found
