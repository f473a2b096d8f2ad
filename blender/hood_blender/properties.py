"""What the user sets: garments from the body outwards, the body, fabrics, pins, frames, quality. It is saved in the .blend."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .command import FABRICS, QUALITIES

_FABRICS = [(name, name.replace("_", " ").capitalize(), f"hood's fabric {name}") for name in FABRICS]


class HoodSlot(bpy.types.PropertyGroup):
    """The fabric of a material slot."""

    fabric: EnumProperty(name="Fabric", items=_FABRICS)  # type: ignore[valid-type]


def _by_slot(garment: Any, context: Any) -> None:
    """As many fabrics as the object has material slots."""
    count = len(garment.object.material_slots) if garment.object else 0
    while len(garment.slots) > count:
        garment.slots.remove(len(garment.slots) - 1)
    while len(garment.slots) < count:
        garment.slots.add().fabric = garment.fabric


class HoodGarment(bpy.types.PropertyGroup):
    """A garment of the outfit."""

    object: PointerProperty(type=bpy.types.Object)  # type: ignore[valid-type]
    fabric: EnumProperty(name="Fabric", items=_FABRICS)  # type: ignore[valid-type]
    by_slot: BoolProperty(  # type: ignore[valid-type]
        name="One for each material slot", description="Material slots have fabrics of their own", update=_by_slot
    )
    slots: CollectionProperty(type=HoodSlot)  # type: ignore[valid-type]
    pins: StringProperty(  # type: ignore[valid-type]
        name="Pins", description="Vertex group that the body holds; a weight below 1 is a spring; empty: no vertex"
    )
    follows: StringProperty(  # type: ignore[valid-type]
        name="Follow", description="Vertex group of the body that the pins follow; empty: the skin nearest to each"
    )
    sew: FloatProperty(  # type: ignore[valid-type]
        name="Sew rims up to",
        description="Metres between rims that become one seam; 0: only rims that lie on each other",
        min=0.0,
        max=0.05,
        precision=4,
    )


class HoodSettings(bpy.types.PropertyGroup):
    """What is baked in a scene."""

    garments: CollectionProperty(type=HoodGarment)  # type: ignore[valid-type]
    active: IntProperty()  # type: ignore[valid-type]
    body: PointerProperty(  # type: ignore[valid-type]
        type=bpy.types.Object, name="Body", description="Mesh, or object with instances, that the garments are worn on"
    )
    own_range: BoolProperty(name="Own frame range", description="Other frames than the scene's")  # type: ignore[valid-type]
    first: IntProperty(name="First frame", default=1)  # type: ignore[valid-type]
    last: IntProperty(name="Last frame", default=250)  # type: ignore[valid-type]
    quality: EnumProperty(  # type: ignore[valid-type]
        name="Quality", items=[(key, name, what) for key, name, what, _ in QUALITIES], default="standard"
    )
    result: EnumProperty(  # type: ignore[valid-type]
        name="Result",
        items=[
            ("CACHE", "Mesh Cache", "A modifier reads the frames from a PC2 file beside the .blend, also while they are made"),
            ("KEYS", "Shape keys", "A shape key a frame, in the .blend, at the end of the bake"),
        ],
    )
    halves: BoolProperty(  # type: ignore[valid-type]
        name="Two steps a frame where it is fast",
        description="Capture and simulate twice a frame if a vertex of the body moves more than 5 cm in a frame",
        default=True,
    )
    threads: IntProperty(name="Threads", description="Processor threads of hood", default=1, min=1, max=64)  # type: ignore[valid-type]
    more: StringProperty(  # type: ignore[valid-type]
        name="More keys", description="Words that hood rollout gets as well, such as damping=0.005 size=1.05"
    )
    name: StringProperty(  # type: ignore[valid-type]
        name="Name", description="Folder in hood_cache beside the .blend; empty: that of file and scene"
    )
    seconds_per_frame: FloatProperty()  # type: ignore[valid-type]


def frames_of(scene: Any) -> tuple[int, int]:
    """First and last frame of the bake."""
    settings = scene.hood
    return (settings.first, settings.last) if settings.own_range else (scene.frame_start, scene.frame_end)


def folder_name(scene: Any) -> str:
    """The name of the bake's folder."""
    return str(scene.hood.name) or f"{Path(bpy.data.filepath).stem}_{scene.name}"


_CLASSES = (HoodSlot, HoodGarment, HoodSettings)


def register() -> None:
    """Make them known."""
    for one in _CLASSES:
        bpy.utils.register_class(one)
    bpy.types.Scene.hood = PointerProperty(type=HoodSettings)


def unregister() -> None:
    """Take them off; what the .blend holds stays in it."""
    del bpy.types.Scene.hood
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
