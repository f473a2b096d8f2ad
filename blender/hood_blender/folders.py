"""Where the files of a bake are."""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy

from .meshes import plain_name


def bake_folder(name: str) -> Path:
    """``hood_cache/NAME`` beside the .blend; of a file that is not saved in the temporary folder of this session."""
    if bpy.data.filepath:
        return Path(bpy.path.abspath("//")).resolve() / "hood_cache" / plain_name(name)
    return Path(bpy.app.tempdir or tempfile.gettempdir()) / "hood_cache" / plain_name(name)


def own_hood() -> Path:
    """The add-on's own installation of hood."""
    return Path(bpy.utils.user_resource("DATAFILES", path="hood_blender")) / "venv"
