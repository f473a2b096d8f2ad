"""Where the files of a bake are."""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy

from .meshes import plain_name


def temporary_folder() -> Path:
    """A folder of this session, for files that are not saved."""
    return Path(bpy.app.tempdir or tempfile.gettempdir())


def bake_folder(name: str) -> Path:
    """``hood_cache/NAME`` beside the .blend; of a file that is not saved in the temporary folder."""
    beside = Path(bpy.path.abspath("//")).resolve() if bpy.data.filepath else temporary_folder()
    return beside / "hood_cache" / plain_name(name)


def own_hood() -> Path:
    """The add-on's own installation of hood."""
    return Path(bpy.utils.user_resource("DATAFILES", path="hood_blender")) / "venv"
