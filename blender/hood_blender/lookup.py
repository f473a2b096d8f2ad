"""Objects by name: pointers of Blender do not survive undo, names do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from .fault import BakeError


def scene_named(name: str) -> Any:
    """A scene.

    Raises:
        BakeError: it is not there any more.
    """
    found = bpy.data.scenes.get(name)
    if found is None:
        raise BakeError(f"scene {name}: is not there any more; bake again in the scene that you want")
    return found


def object_named(name: str, uid: int) -> Any:
    """An object by its name, or by its number of this session where it was renamed.

    Raises:
        BakeError: it is not there any more.
    """
    local = bpy.data.objects.get((name, None)) or bpy.data.objects.get(name)
    if local is None or local.session_uid != uid:
        local = next((one for one in bpy.data.objects if one.session_uid == uid), local)
    if local is None:
        raise BakeError(f"{name}: is not there any more; undo its deletion, or take it out of the list")
    return local


def curves_of(action: Any) -> Iterator[Any]:
    """All F-curves of an action, in the layers of new versions or without them."""
    if not hasattr(action, "layers") or (not len(action.layers) and hasattr(action, "fcurves")):
        yield from action.fcurves
        return
    for layer in action.layers:
        for strip in layer.strips:
            for bag in getattr(strip, "channelbags", ()):
                yield from bag.fcurves


def scale_of(scene: Any) -> float:
    """Metres per unit of a scene."""
    units = scene.unit_settings
    return 1.0 if units.system == "NONE" else float(units.scale_length)


def fps_of(scene: Any) -> float:
    """Frames per second of a scene."""
    return float(scene.render.fps / scene.render.fps_base)
