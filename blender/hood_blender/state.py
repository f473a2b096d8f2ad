"""What a bake keeps in its folder between sessions: which capture and which run lie there, and how they map to Blender."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from . import command


def digest(*parts: Any) -> str:
    """A key of values and arrays: the same for the same, another for anything else."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            found.update(f"{part.dtype}{part.shape}".encode())
            found.update(np.ascontiguousarray(part).tobytes())
        else:
            found.update(json.dumps(part, sort_keys=True, default=str).encode())
        found.update(b"\0")
    return found.hexdigest()


def run_key(folder: Path, words: Sequence[str], files: Iterable[str]) -> str:
    """The key of a run: its command and what its files hold."""
    return digest(list(words), [hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in files])


def read_state(folder: Path) -> dict[str, Any]:
    """What was kept; empty where nothing is, or it cannot be read."""
    try:
        content = json.loads((folder / "bake.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def write_state(folder: Path, **changed: Any) -> None:
    """Keep values beside those that are there; the file is whole at any moment."""
    content = read_state(folder) | changed
    draft = folder / "bake.json.partial"
    draft.write_text(json.dumps(content), encoding="utf-8")
    os.replace(draft, folder / "bake.json")


def cache_of(folder: Path, name: str) -> Path | None:
    """The cache that hood writes for a garment; None while there is none. Where hood puts it is said here alone."""
    run = folder / command.RUN
    places = (run / "rollout_pc2", run)
    return next((place / f"{name}.pc2" for place in places if (place / f"{name}.pc2").is_file()), None)
