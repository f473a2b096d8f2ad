"""Wheels carry the C++ parts compiled for their platform; without a compiler they are pure Python and compile at first use."""

from __future__ import annotations

import importlib
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags


class NativeHook(BuildHookInterface[Any]):
    """Compiles what ``hood/native/build.py`` lists and adds it to the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Editable installations have the sources at hand and compile at the first use."""
        if version == "editable":
            return
        sys.path.insert(0, self.root)  # hood.native needs nothing but the standard library
        libraries = importlib.import_module("hood.native.build")
        self._folder = tempfile.TemporaryDirectory()
        made, left_out = libraries.make(Path(self._folder.name))
        for sentence in left_out:
            self.app.display_warning(sentence)
        if made:
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{next(platform_tags())}"
            build_data["force_include"].update({str(path): f"hood/native/prebuilt/{path.name}" for path in made})

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """The compiled files are in the wheel now."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()
