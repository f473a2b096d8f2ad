"""The buttons of the panel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bmesh
import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty

from . import finding, job, process, results
from .bake import bake
from .fault import REPAIRS, BakeError
from .folders import own_hood
from .plan import Progress
from .planning import plan_of
from .preferences import INSTALL, preference
from .properties import frames_of

_UNDO = {"REGISTER", "UNDO"}


class HOOD_OT_garment_add(bpy.types.Operator):
    """Add the selected meshes to the garments, outermost last"""

    bl_idname, bl_label, bl_options = "hood.garment_add", "Add", _UNDO

    def execute(self, context: Any) -> set[str]:
        """Add what is not in the list."""
        settings = context.scene.hood
        there = {garment.object for garment in settings.garments}
        new = [one for one in context.selected_objects if one.type == "MESH" and one not in there and one != settings.body]
        if not new:
            self.report({"WARNING"}, "Select a mesh that is neither the body nor in the list")
            return {"CANCELLED"}
        for one in new:
            settings.garments.add().object = one
        settings.active = len(settings.garments) - 1
        return {"FINISHED"}


class HOOD_OT_garment_remove(bpy.types.Operator):
    """Take the garment out of the list; its object and its result stay"""

    bl_idname, bl_label, bl_options = "hood.garment_remove", "Remove", _UNDO

    def execute(self, context: Any) -> set[str]:
        """Take it out."""
        settings = context.scene.hood
        if not 0 <= settings.active < len(settings.garments):
            return {"CANCELLED"}
        settings.garments.remove(settings.active)
        settings.active = max(0, min(settings.active, len(settings.garments) - 1))
        return {"FINISHED"}


class HOOD_OT_garment_move(bpy.types.Operator):
    """Move the garment towards the body or outwards"""

    bl_idname, bl_label, bl_options = "hood.garment_move", "Move", _UNDO
    direction: EnumProperty(items=[("UP", "To the body", ""), ("DOWN", "Outwards", "")])  # type: ignore[valid-type]

    def execute(self, context: Any) -> set[str]:
        """Change places with its neighbour."""
        settings = context.scene.hood
        to = settings.active + (-1 if self.direction == "UP" else 1)
        if not (0 <= to < len(settings.garments) and 0 <= settings.active < len(settings.garments)):
            return {"CANCELLED"}
        settings.garments.move(settings.active, to)
        settings.active = to
        return {"FINISHED"}


class HOOD_OT_body_set(bpy.types.Operator):
    """Take the active object as the body"""

    bl_idname, bl_label, bl_options = "hood.body_set", "Active object", _UNDO

    def execute(self, context: Any) -> set[str]:
        """Take it, and out of the garments."""
        settings, active = context.scene.hood, context.active_object
        if active is None:
            self.report({"WARNING"}, "No object is active; click the body")
            return {"CANCELLED"}
        settings.body = active
        for place in reversed(range(len(settings.garments))):
            if settings.garments[place].object == active:
                settings.garments.remove(place)
        return {"FINISHED"}


def _begin(operator: Any, context: Any, estimate: bool, again: bool, wait: bool) -> set[str]:
    scene = context.scene
    running = job.job_of(scene.name)
    if running is not None and running.running:
        operator.report({"WARNING"}, "A bake of this scene runs; cancel it first")
        return {"CANCELLED"}
    progress = Progress()
    try:
        plan = plan_of(context, estimate, again)
    except BakeError as error:
        job.start(scene.name, _failing(error), progress, True)
        operator.report({"ERROR"}, str(error))
        return {"CANCELLED"}
    if not bpy.data.filepath and not estimate:
        progress.notes.append("the .blend is not saved: the cache is temporary; save the file and bake again to keep it")
    begun = job.start(scene.name, _with_time(bake(plan, progress), progress, scene.name), progress, wait)
    if wait and begun.error:
        operator.report({"ERROR"}, begun.error)
        return {"CANCELLED"}
    return {"FINISHED"}


def _failing(error: BakeError) -> Iterator[float]:
    raise error
    yield 0.0


def _with_time(steps: Iterator[float], progress: Progress, scene: str) -> Iterator[float]:
    """A bake, and then its time per frame in the scene."""
    yield from steps
    there = bpy.data.scenes.get(scene)
    if there is not None and progress.seconds_per_frame > 0:
        there.hood.seconds_per_frame = progress.seconds_per_frame
    if bpy.ops.ed.undo_push.poll():  # so that undoing the user's next step does not take the modifier off
        bpy.ops.ed.undo_push(message="hood bake")


class HOOD_OT_bake(bpy.types.Operator):
    """Capture the body, simulate beside Blender and show the frames as they come; goes on where one was cancelled"""

    bl_idname, bl_label, bl_options = "hood.bake", "Bake", {"REGISTER"}
    again: BoolProperty(name="Capture again", description="Capture the body even if it seems unchanged")  # type: ignore[valid-type]
    wait: BoolProperty(name="Wait", description="Return at the end; for scripts", options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def execute(self, context: Any) -> set[str]:
        """Begin it."""
        return _begin(self, context, False, self.again, self.wait)


class HOOD_OT_estimate(bpy.types.Operator):
    """Simulate six frames in a folder of their own, and say how long all of them take"""

    bl_idname, bl_label, bl_options = "hood.estimate", "Estimate time", {"REGISTER"}
    wait: BoolProperty(name="Wait", description="Return at the end; for scripts", options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def execute(self, context: Any) -> set[str]:
        """Begin it."""
        return _begin(self, context, True, True, self.wait)


class HOOD_OT_cancel(bpy.types.Operator):
    """End the bake; finished frames stay, the next bake goes on"""

    bl_idname, bl_label = "hood.cancel", "Cancel"

    def execute(self, context: Any) -> set[str]:
        """End it."""
        running = job.job_of(context.scene.name)
        if running is None or not running.running:
            return {"CANCELLED"}
        running.cancel()
        return {"FINISHED"}


class HOOD_OT_clear(bpy.types.Operator):
    """Take the result off the garments; the cache files stay"""

    bl_idname, bl_label, bl_options = "hood.clear", "Remove result", _UNDO

    def execute(self, context: Any) -> set[str]:
        """Take modifiers and shape keys off."""
        for garment in context.scene.hood.garments:
            if garment.object is not None and garment.object.library is None:
                results.detach_cache(garment.object)
                results.remove_keys(garment.object)
        return {"FINISHED"}


class HOOD_OT_fault_select(bpy.types.Operator):
    """Select the vertices or faces that this row names, in edit mode and in its frame"""

    bl_idname, bl_label, bl_options = "hood.fault_select", "Select", _UNDO
    index: IntProperty()  # type: ignore[valid-type]

    def execute(self, context: Any) -> set[str]:
        """Select them."""
        told = job.job_of(context.scene.name)
        if told is None or not 0 <= self.index < len(told.progress.faults):
            return {"CANCELLED"}
        fault = told.progress.faults[self.index]
        garment = context.scene.objects.get(fault.garment)
        if garment is None or not (fault.vertices or fault.faces):
            self.report({"INFO"}, "This row names no vertex of a garment of this scene")
            return {"CANCELLED"}
        if fault.frame is not None:
            context.scene.frame_set(frames_of(context.scene)[0] + fault.frame)
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        for one in context.selected_objects:
            one.select_set(False)
        garment.select_set(True)
        context.view_layer.objects.active = garment
        by_face = bool(fault.faces)
        context.tool_settings.mesh_select_mode = (not by_face, False, by_face)
        bpy.ops.object.mode_set(mode="EDIT")
        select_in(garment.data, fault.vertices, fault.faces)
        return {"FINISHED"}


def select_in(mesh: Any, vertices: list[int], faces: list[int]) -> None:
    """Select these vertices, or faces, of a mesh in edit mode and nothing else."""
    edited = bmesh.from_edit_mesh(mesh)
    edited.verts.ensure_lookup_table()
    edited.faces.ensure_lookup_table()
    for kind in (edited.faces, edited.edges, edited.verts):
        for one in kind:
            one.select_set(False)
    for chosen in [edited.faces[face] for face in faces] or [edited.verts[vertex] for vertex in vertices]:
        chosen.select_set(True)
    edited.select_flush_mode()
    bmesh.update_edit_mesh(mesh, loop_triangles=False, destructive=False)


class HOOD_OT_fault_repair(bpy.types.Operator):
    """Set what repairs this in the next bake"""

    bl_idname, bl_label, bl_options = "hood.fault_repair", "Repair", _UNDO
    index: IntProperty()  # type: ignore[valid-type]

    def execute(self, context: Any) -> set[str]:
        """Change the settings; the bake is the user's."""
        told, settings = job.job_of(context.scene.name), context.scene.hood
        if told is None or not 0 <= self.index < len(told.progress.faults):
            return {"CANCELLED"}
        fault = told.progress.faults[self.index]
        if fault.repair not in REPAIRS:
            return {"CANCELLED"}
        if fault.repair == "sew":
            for garment in settings.garments:
                if not fault.garment or (garment.object and garment.object.name == fault.garment):
                    garment.sew = 0.005
        words = REPAIRS[fault.repair][1]
        keys = {word.partition("=")[0] for word in words}
        kept = [word for word in settings.more.split() if word.partition("=")[0] not in keys]
        settings.more = " ".join([*kept, *words])
        self.report({"INFO"}, f"{REPAIRS[fault.repair][0]}: bake again")
        return {"FINISHED"}


class HOOD_OT_install(bpy.types.Operator):
    """Make a Python environment of the add-on's own and fetch hood into it with pip"""

    bl_idname, bl_label = "hood.install", "Install hood"
    wait: BoolProperty(options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def execute(self, context: Any) -> set[str]:
        """Begin it."""
        running = job.job_of(INSTALL)
        if running is not None and running.running:
            return {"CANCELLED"}
        progress = Progress()
        try:
            python = finding.python_for(preference("python"))
            commands = finding.install_commands(python, own_hood(), preference("source"))
        except BakeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        begun = job.start(INSTALL, installing(commands, progress), progress, self.wait)
        if self.wait and begun.error:
            self.report({"ERROR"}, begun.error)
            return {"CANCELLED"}
        return {"FINISHED"}


def installing(commands: list[list[str]], progress: Progress) -> Iterator[float]:
    """Run the commands of an installation one after the other.

    Raises:
        BakeError: one of them failed.
    """
    folder = own_hood().parent
    for command in commands:
        progress.work = "Making the environment" if "venv" in command else "Fetching hood"
        folder.mkdir(parents=True, exist_ok=True)
        running = process.Process(command, folder, folder / "install.txt")
        try:
            while running.code is None:
                lines = running.said().split("\n")
                progress.notes = [lines[-2][:100]] if len(lines) > 1 else []
                yield 0.5
        finally:
            running.kill()
        if running.code:
            last = (running.said().strip().splitlines() or ["it said nothing"])[-1]
            raise BakeError(f"the installation failed: {last} (all of it in {folder / 'install.txt'})")
    progress.work = "hood is installed"


_CLASSES = (
    HOOD_OT_garment_add,
    HOOD_OT_garment_remove,
    HOOD_OT_garment_move,
    HOOD_OT_body_set,
    HOOD_OT_bake,
    HOOD_OT_estimate,
    HOOD_OT_cancel,
    HOOD_OT_clear,
    HOOD_OT_fault_select,
    HOOD_OT_fault_repair,
    HOOD_OT_install,
)

#: Make them known, and take them off.
register, unregister = bpy.utils.register_classes_factory(_CLASSES)
