"""The panel in the sidebar of the 3D view."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from .fault import REPAIRS
from .job import job_of
from .process import in_words
from .properties import frames_of

#: Faults that are shown, and signs of a line.
_MOST, _WIDTH = 8, 46


class HOOD_UL_garments(bpy.types.UIList):
    """Garments from the body outwards."""

    def draw_item(
        self, context: Any, layout: Any, data: Any, item: Any, icon: Any, active: Any, where: Any, index: Any
    ) -> None:
        """One row."""
        layout.prop(item, "object", text="", emboss=False, icon="MATCLOTH")


class HOOD_PT_main(bpy.types.Panel):
    """Garments, body, frames, and the bake."""

    bl_label, bl_category, bl_space_type, bl_region_type = "hood", "hood", "VIEW_3D", "UI"

    def draw(self, context: Any) -> None:
        """All of the panel."""
        layout, scene = self.layout, context.scene
        settings = scene.hood
        layout.prop(settings, "body")
        layout.operator("hood.body_set", icon="OUTLINER_OB_ARMATURE")
        layout.label(text="Garments, from the body outwards")
        row = layout.row()
        row.template_list("HOOD_UL_garments", "", settings, "garments", settings, "active", rows=3)
        column = row.column(align=True)
        column.operator("hood.garment_add", text="", icon="ADD")
        column.operator("hood.garment_remove", text="", icon="REMOVE")
        column.operator("hood.garment_move", text="", icon="TRIA_UP").direction = "UP"
        column.operator("hood.garment_move", text="", icon="TRIA_DOWN").direction = "DOWN"
        if 0 <= settings.active < len(settings.garments):
            _draw_garment(layout.box(), settings.garments[settings.active], settings.body)
        _draw_bake(layout, scene, settings)
        _draw_job(layout, job_of(scene.name))


def _draw_garment(layout: Any, garment: Any, body: Any) -> None:
    one = garment.object
    if one is None:
        layout.label(text="Its object is gone", icon="ERROR")
        return
    layout.prop(garment, "fabric")
    if len(one.material_slots) > 1:
        layout.prop(garment, "by_slot")
        if garment.by_slot:
            for slot, fabric in zip(one.material_slots, garment.slots, strict=False):
                layout.prop(fabric, "fabric", text=slot.name or "empty slot")
    layout.prop_search(garment, "pins", one, "vertex_groups")
    if garment.pins and body is not None:
        layout.prop_search(garment, "follows", body, "vertex_groups")
    layout.prop(garment, "sew")


def _draw_bake(layout: Any, scene: Any, settings: Any) -> None:
    layout.prop(settings, "own_range")
    if settings.own_range:
        row = layout.row(align=True)
        row.prop(settings, "first")
        row.prop(settings, "last")
    for key in ("quality", "result", "halves", "threads", "more", "name"):
        layout.prop(settings, key)
    first, last = frames_of(scene)
    text = f"Frames {first} to {last}"
    if settings.seconds_per_frame > 0 and last > first:
        each = settings.seconds_per_frame
        text += f": {each:.2g} s each, about {in_words(each * (last - first + 1))}"
    layout.label(text=text, icon="TIME")
    row = layout.row(align=True)
    row.operator("hood.estimate")
    row.operator("hood.bake", icon="PLAY")
    layout.operator("hood.clear")


def _draw_job(layout: Any, job: Any) -> None:
    if job is None:
        return
    progress = job.progress
    box = layout.box()
    if job.running:
        share = progress.done / progress.total if progress.total else 0.0
        left = f", {progress.left} left" if progress.left else ""
        box.progress(factor=share, text=f"{progress.work}: {progress.done} of {progress.total}{left}")
        box.operator("hood.cancel", icon="CANCEL")
    else:
        box.label(text="Not baked" if job.error else progress.work, icon="ERROR" if job.error else "INFO")
    for note in progress.notes:
        _draw_text(box, note)
    for index, fault in enumerate(progress.faults[:_MOST]):
        own = box.box()
        _draw_text(own, fault.text)
        row = own.row(align=True)
        if fault.vertices or fault.faces:
            count = len(fault.faces) or len(fault.vertices)
            what = "faces" if fault.faces else "vertices"
            row.operator("hood.fault_select", text=f"Select {count} {what}").index = index
        if fault.repair in REPAIRS:
            row.operator("hood.fault_repair", text=REPAIRS[fault.repair][0]).index = index
    if len(progress.faults) > _MOST:
        box.label(text=f"and {len(progress.faults) - _MOST} more")


def _draw_text(layout: Any, text: str) -> None:
    column = layout.column(align=True)
    for line in textwrap.wrap(text, _WIDTH):
        column.label(text=line)


_CLASSES = (HOOD_UL_garments, HOOD_PT_main)

#: Make them known, and take them off.
register, unregister = bpy.utils.register_classes_factory(_CLASSES)
