"""Preferences of the add-on: where hood is, and its installation."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import StringProperty

from .folders import own_hood
from .job import job_of

#: Under which jobs of no scene are kept.
INSTALL = "\0install"


class HoodPreferences(bpy.types.AddonPreferences):
    """Where hood is, and where a new one comes from."""

    bl_idname = __package__

    program: StringProperty(  # type: ignore[valid-type]
        name="hood", subtype="FILE_PATH", description="Program or Python that has hood; empty: the installed one, then the PATH"
    )
    source: StringProperty(  # type: ignore[valid-type]
        name="Source",
        subtype="FILE_PATH",
        description="Wheel, folder of wheels or of hood's code, or address of an index that has hood-cloth",
    )
    python: StringProperty(  # type: ignore[valid-type]
        name="Python", subtype="FILE_PATH", description="Python 3.11 or newer that makes the environment; empty: Blender's own"
    )

    def draw(self, context: Any) -> None:
        """Rows of the preferences."""
        layout = self.layout
        layout.prop(self, "program")
        box = layout.box()
        box.prop(self, "source")
        box.prop(self, "python")
        what = f"Fetches {self.source}" if self.source else "Name a source; fetches it"
        box.label(text=f"{what} with PyTorch, NumPy, SciPy and others: about 1 GB, 3 GB on disk")
        box.label(text=f"Into {own_hood()}")
        box.operator("hood.install")
        job = job_of(INSTALL)
        if job is not None:
            box.label(text=job.error or job.progress.work, icon="ERROR" if job.error else "INFO")


def preference(name: str) -> str:
    """A preference; empty where the add-on runs without any."""
    addon = bpy.context.preferences.addons.get(__package__)
    return str(getattr(addon.preferences, name, "")) if addon is not None and addon.preferences is not None else ""


def register() -> None:
    """Make them known."""
    bpy.utils.register_class(HoodPreferences)


def unregister() -> None:
    """Take them off."""
    bpy.utils.unregister_class(HoodPreferences)
