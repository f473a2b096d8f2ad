"""Characters and garments made with Blender's own means, for the tests inside Blender."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np


def fresh(fps: int = 24, last: int = 6, scale: float = 1.0) -> Any:
    """An empty scene of frames 1 to ``last``; ``scale`` metres per unit."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = fps, 1, last
    scene.unit_settings.scale_length = scale
    return scene


def add(name: str, vertices: Any, faces: Any) -> Any:
    """A mesh object in the scene."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, row)) for row in vertices], [], [tuple(map(int, row)) for row in faces])
    mesh.update()
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


def tube(sides: int, rings: int, radius: float, low: float, high: float, caps: bool = False) -> tuple[np.ndarray, list[Any]]:
    """Vertices and quads of a tube about z, closed by ``caps``."""
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([circle, np.full(sides, z)]) for z in np.linspace(low, high, rings)])
    faces: list[Any] = [
        (r * sides + k, r * sides + (k + 1) % sides, (r + 1) * sides + (k + 1) % sides, (r + 1) * sides + k)
        for r in range(rings - 1)
        for k in range(sides)
    ]
    if caps:
        faces += [tuple(reversed(range(sides))), tuple(range((rings - 1) * sides, rings * sides))]
    return vertices, faces


def character(unit: float = 1.0, swing: float = 0.15) -> tuple[Any, Any]:
    """A trunk of 1 m with an armature of two bones; the upper one bends, the whole walks. ``unit``: units a metre."""
    vertices, faces = tube(20, 13, 0.15, 0.0, 1.0, caps=True)
    body = add("Body", vertices * unit, faces)
    data = bpy.data.armatures.new("Rig")
    rig = bpy.data.objects.new("Rig", data)
    bpy.context.scene.collection.objects.link(rig)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    for name, low, high in (("hips", 0.0, 0.5), ("chest", 0.5, 1.0)):
        bone = data.edit_bones.new(name)
        bone.head, bone.tail = (0, 0, low * unit), (0, 0, high * unit)
    data.edit_bones["chest"].parent = data.edit_bones["hips"]
    bpy.ops.object.mode_set(mode="OBJECT")
    for name, inside in (("hips", vertices[:, 2] <= 0.5), ("chest", vertices[:, 2] > 0.5)):
        body.vertex_groups.new(name=name).add(np.flatnonzero(inside).tolist(), 1.0, "REPLACE")
    body.parent = rig
    body.modifiers.new("Armature", "ARMATURE").object = rig
    last = bpy.context.scene.frame_end
    chest = rig.pose.bones["chest"]
    chest.rotation_mode = "XYZ"
    for frame, share in ((1, 0.0), (last, 1.0)):
        chest.rotation_euler = (0.0, 0.0, swing * share)
        chest.keyframe_insert("rotation_euler", frame=frame)
        rig.location = (0.02 * unit * share, 0.01 * unit * share, 0.0)
        rig.keyframe_insert("location", frame=frame)
    return body, rig


def skirt(unit: float = 1.0, name: str = "Skirt", radius: float = 0.16, low: float = 0.35, high: float = 0.7) -> Any:
    """A tube of cloth around the trunk, of quads, whose upper rim is the vertex group ``waist``."""
    vertices, faces = tube(32, 9, radius, low, high)
    made = add(name, vertices * unit, faces)
    made.vertex_groups.new(name="waist").add(np.flatnonzero(vertices[:, 2] > high - 1e-6).tolist(), 1.0, "REPLACE")
    return made


def wear(body: Any, *garments: Any, pins: str = "waist") -> Any:
    """Put the garments into the list, from the body outwards; the settings."""
    settings = bpy.context.scene.hood
    settings.body = body
    for garment in garments:
        row = settings.garments.add()
        row.object, row.pins = garment, pins
    return settings


def turned(made: Any, angle: float = 0.4, scale: tuple[float, float, float] = (2.0, 0.5, 1.25)) -> None:
    """Give an object a rotation, scale and place of its own; its mesh stays where it is in the world."""
    made.rotation_euler, made.scale, made.location = (angle, 0.2, math.pi / 5), scale, (0.3, -0.2, 0.1)
    bpy.context.view_layer.update()
    made.data.transform(made.matrix_world.inverted())
    made.data.update()


def world_at(made: Any, frame: int) -> np.ndarray:
    """(V, 3) evaluated positions in the world of Blender."""
    bpy.context.scene.frame_set(frame)
    one = made.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = one.to_mesh()
    pos = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", pos)
    matrix = np.array(one.matrix_world)
    return pos.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
