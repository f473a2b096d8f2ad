"""What a bake leaves in Blender: a Mesh Cache modifier on every garment, or shape keys with keyed values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from .lookup import curves_of
from .stack import CACHE, MUTED, OFF, cut_of, own_keys, switched_off


def attach_cache(garment: Any, cache: Path, first: int) -> None:
    """The garment's Mesh Cache modifier, added once, before the modifiers that give the cloth thickness or finer faces.

    Args:
        cache: positions in the garment's own space, one sample a frame from frame ``first`` on.
    """
    modifier = garment.modifiers.get(CACHE)
    if modifier is None or modifier.type != "MESH_CACHE":
        place = cut_of(garment)
        modifier = garment.modifiers.new(CACHE, "MESH_CACHE")
        garment.modifiers.move(len(garment.modifiers) - 1, place)
        modifier = garment.modifiers[place]
    path = _written(cache)
    for key, value in (
        ("cache_format", "PC2"),
        ("filepath", path),
        ("interpolation", "LINEAR"),
        ("deform_mode", "OVERWRITE"),
        ("time_mode", "FRAME"),
        ("play_mode", "SCENE"),
        ("frame_start", float(first)),
        ("frame_scale", 1.0),
        ("forward_axis", "POS_Y"),
        ("up_axis", "POS_Z"),
    ):
        if getattr(modifier, key) != value:
            setattr(modifier, key, value)
    modifier.flip_axis = set() if isinstance(modifier.flip_axis, set) else (False, False, False)  # 4.2 has a set
    modifier.show_viewport = modifier.show_render = True
    refresh(garment)


def _written(cache: Path) -> str:
    """A path as a .blend keeps it: relative where the file is saved and on the same drive."""
    if not bpy.data.filepath:
        return str(cache)
    try:
        return bpy.path.relpath(str(cache))
    except ValueError:
        return str(cache)


def refresh(garment: Any) -> None:
    """Make Blender read the cache again: there are frames more in it."""
    garment.update_tag(refresh={"DATA"})


def detach_cache(garment: Any) -> None:
    """Take the modifier off."""
    modifier = garment.modifiers.get(CACHE)
    if modifier is not None and modifier.type == "MESH_CACHE":
        garment.modifiers.remove(modifier)


def remove_keys(garment: Any) -> None:
    """Take off the shape keys of an earlier bake, and their curves; what they have switched off is on again."""
    modifiers, muted = switched_off(garment)
    for modifier in modifiers:
        modifier.show_viewport = modifier.show_render = True
    for key in muted:
        key.mute = False
    for name in (OFF, MUTED):
        garment.pop(name, None)
    keys = garment.data.shape_keys
    if keys is None:
        return
    own = own_keys(garment)
    for key in own:
        key.driver_remove("value")
        keys_path = f'key_blocks["{key.name}"].value'
        if keys.animation_data and keys.animation_data.action:
            _remove_curve(keys.animation_data.action, keys_path)
    for key in own:
        garment.shape_key_remove(key)


def _remove_curve(action: Any, path: str) -> None:
    holders = [action] if hasattr(action, "fcurves") and not len(getattr(action, "layers", ())) else []
    for layer in getattr(action, "layers", ()):
        holders += [bag for strip in layer.strips for bag in strip.channelbags]
    for holder in holders:
        for curve in [curve for curve in holder.fcurves if curve.data_path == path]:
            holder.fcurves.remove(curve)


def key_shapes(garment: Any, samples: np.ndarray, first: int) -> None:
    """One shape key a frame, at its value 1 in that frame and 0 in the others, linearly between.

    Modifiers that deform the garment before its cache would act again on it: they are switched off.

    Args:
        samples: (T, V, 3) in the garment's own space.
    """
    detach_cache(garment)
    remove_keys(garment)
    off = [modifier for modifier in list(garment.modifiers)[: cut_of(garment)] if modifier.show_viewport]
    for modifier in off:
        modifier.show_viewport = modifier.show_render = False
    garment[OFF] = [modifier.name for modifier in off]
    if garment.data.shape_keys is None:
        garment.shape_key_add(name="Basis", from_mix=False)
    blocks = garment.data.shape_keys.key_blocks
    others = [other for other in list(blocks)[1:] if not other.mute]
    for other in others:
        other.mute = True  # what they did is in the samples
    garment[MUTED] = [other.name for other in others]
    for number, pos in enumerate(samples):
        key = garment.shape_key_add(name=f"{CACHE}_{number:04d}", from_mix=False)
        key.data.foreach_set("co", np.ascontiguousarray(pos, np.float32).ravel())
        key.slider_max = 1.0
        for frame, value in ((first + number - 1, 0.0), (first + number, 1.0), (first + number + 1, 0.0)):
            end = (number == 0 and frame < first) or (number == len(samples) - 1 and frame > first + number)
            key.value = 1.0 if end else value
            key.keyframe_insert("value", frame=frame)
    keys = garment.data.shape_keys
    for curve in curves_of(keys.animation_data.action):
        if curve.data_path.startswith(f'key_blocks["{CACHE}_'):
            for point in curve.keyframe_points:
                point.interpolation = "LINEAR"
