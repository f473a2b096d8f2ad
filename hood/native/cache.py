"""The folder for files that can be made again, such as compiled libraries."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder() -> Path | None:
    """The user's cache folder as the platform has it, or ``HOOD_CACHE``; None where that turns caching off."""
    chosen = os.environ.get("HOOD_CACHE")
    if chosen is not None:
        return None if chosen.strip().lower() in ("", "off") else Path(chosen).expanduser()
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home
        return None
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")) / "hood" / "Cache"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "hood"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "hood"
