"""Names of the embedded defaults and their files; a name that does not exist names its nearest neighbours."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

DATA_FOLDER = Path(__file__).resolve().parent.parent / "data"
_LABEL = {"body": "body", "garments": "garment", "motions": "sequence", "weights": "checkpoint"}
_SUFFIX = {"body": ".npz", "garments": ".npz", "motions": ".npz", "weights": ".safetensors"}


def names(kind: str) -> list[str]:
    """Names of the embedded ``"body"``, ``"garments"``, ``"motions"`` or ``"weights"``."""
    return sorted(path.stem for path in (DATA_FOLDER / kind).glob("*" + _SUFFIX[kind]))


def locate(kind: str, name: str | Path) -> Path:
    """File of an embedded asset, or the user's own file.

    Raises:
        FileNotFoundError: neither an embedded name nor an existing file; the message lists the nearest names.
    """
    embedded = DATA_FOLDER / kind / f"{name}{_SUFFIX[kind]}"
    if embedded.is_file():
        return embedded
    path = Path(name).expanduser()
    if path.is_file():
        return path
    if path.suffix or len(path.parts) > 1:
        raise FileNotFoundError(f"{path}: no such file (embedded {kind}: {', '.join(names(kind)) or 'none'})")
    raise FileNotFoundError(unknown(_LABEL[kind], str(name), names(kind)) + "; or give the path of a file")


def unknown(what: str, given: str, known: Iterable[str]) -> str:
    """The sentence for a misspelt name: the nearest known one first."""
    known = list(known)
    near = difflib.get_close_matches(given, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"unknown {what} {given!r}: {hint}known are {', '.join(known) or 'none'}"


def motion_split() -> dict[str, list[str]]:
    """Embedded motions by split: ``{"train": [...], "validation": [...]}``."""
    with open(DATA_FOLDER / "motions" / "split.json", encoding="utf-8") as file:
        split: dict[str, list[str]] = json.load(file)
    return split


def read_arrays(path: Path, required: Iterable[str], what: str) -> dict:
    """Arrays of an ``.npz`` file, never unpickled.

    Raises:
        ValueError: not an npz file, or a required key is missing; names file, key and fix.
    """

    try:
        with np.load(path, allow_pickle=False) as archive:
            if not hasattr(archive, "files"):
                raise ValueError("a single array")
            arrays = _plain_members(archive, set(required))
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable {what} .npz file ({_first_line(error)})") from error
    missing = [key for key in required if key not in arrays]
    if missing:
        raise ValueError(f"{path}: not a {what} file: key {missing[0]!r} is missing (found {sorted(arrays)[:8]})")
    return arrays


def _plain_members(archive: Any, required: set[str]) -> dict:
    """Members of an open archive; those that would need unpickling (strings of old files) are passed over unless required."""
    arrays = {}
    for key in archive.files:
        try:
            arrays[key] = archive[key]
        except ValueError:
            if key in required:
                raise
    return arrays


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
