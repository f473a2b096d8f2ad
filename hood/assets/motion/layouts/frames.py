"""Files that hold one entry a frame, gathered into one table a person."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.text import flat, squeezed
from hood.assets.motion.layouts.content import counts_of, find_layout, length
from hood.assets.motion.layouts.rotations import as_turns

#: Names of frames: those of pictures, and numbers behind such a word.
_FRAME_NAME = re.compile(r".*\.(jpe?g|png|bmp|webp)$|(frame|image|img)[_ -]?\d+$", re.IGNORECASE)
_IDS = ("tid", "trackids", "trackedids", "trackid", "id", "personid", "subjectid")
#: Keys of the dicts that hold the pose of each person of a frame.
_POSES = ("smpl", "smplparams", "predsmplparams", "params")
#: Containers within each other that are looked into.
_DEEPEST = 4


def gather_frames(path: Path, content: Any, depth: int = 0) -> Any:
    """``content`` with a dict of people, each with tables of one row a frame, for whatever in it has one entry a frame.

    People are told apart by the number that trackers give them; ``frame_ids`` say in which frames each is seen.

    Raises:
        ValueError: several people in a frame and no such numbers; names the file.
    """
    entries = _entries(content)
    if entries is None:
        if depth < _DEEPEST and isinstance(content, Mapping):
            return {key: gather_frames(path, value, depth + 1) for key, value in content.items()}
        if depth < _DEEPEST and isinstance(content, list) and len(content) == 1:
            return [gather_frames(path, content[0], depth + 1)]
        return content
    people: dict[str, list[dict[str, Any]]] = {}
    for frame, entry in enumerate(entries):
        rows = _rows(entry)
        names = [str(row.get("person", number)) for number, row in enumerate(rows)]
        if len(rows) > 1 and (len(set(names)) < len(rows) or any("person" not in row for row in rows)):
            raise ValueError(
                f"{path}: holds {len(rows)} people in its frame {frame} and no track numbers to tell them apart; write one "
                "file a person, with poses (N, 72) and trans (N, 3)"
            )
        for name, row in zip(names, rows, strict=True):
            people.setdefault(name, []).append({**row, "frame_ids": frame})
    return {name: _stacked(rows) for name, rows in people.items()}


def _entries(content: Any) -> list[Any] | None:
    """What stands for each frame; None where the content is not arranged so."""
    if isinstance(content, Mapping) and len(content) > 1:
        pictures = [key for key in content if _FRAME_NAME.fullmatch(key) and isinstance(content[key], (Mapping, list))]
        if len(pictures) > 1:
            return [content[key] for key in sorted(pictures, key=_numbers)]
        values = [content[key] for key in sorted(content, key=_numbers)]
        return values if all(key.isdigit() and _is_row(content[key]) for key in content) else None
    if isinstance(content, list) and len(content) > 1 and all(_is_row(entry) for entry in content):
        return content
    return None


def _numbers(key: str) -> tuple[list[int], str]:
    return [int(digits[-18:]) for digits in re.findall(r"\d+", key)], key


def _is_row(entry: Any) -> bool:
    """Whether a dict holds the pose of one frame alone."""
    if not isinstance(entry, Mapping):
        return False
    keys = {squeezed(key): key for key in entry}
    layout = find_layout(keys)
    if layout is None:
        return False
    try:
        parts = [(key, np.asarray(entry[keys[key]], dtype=float)) for key in layout.poses]
        return all(len(as_turns(Path(), key, array, *counts_of(key)).values) == 1 for key, array in parts)
    except (TypeError, ValueError):  # no numbers, rows of several lengths, or no rotations of these joints
        return False


def _rows(entry: Any) -> list[dict[str, Any]]:
    """The people of one frame, each a dict; the key ``person`` has the number that a tracker gave it."""
    if isinstance(entry, list):
        return [row for part in entry for row in _rows(part)]
    if not isinstance(entry, Mapping):
        return []
    fields = {squeezed(key): value for key, value in entry.items()}
    poses = next((fields[key] for key in _POSES if isinstance(fields.get(key), list)), None)
    layout = find_layout({key: key for key in fields})
    if poses is not None:
        count = len(poses)
    elif layout is None:
        return []
    else:
        count = 1 if _is_row(entry) else len(fields[layout.poses[0]])
        if count == 1:
            return [_named(dict(fields))]
    rows = []
    for index in range(count):
        own = {key: value[index] for key, value in fields.items() if length(value) == count}
        if poses is not None and isinstance(poses[index], Mapping):
            own |= {squeezed(key): value for key, value in poses[index].items()}
        rows.append(_named(own))
    return rows


def _named(row: dict[str, Any]) -> dict[str, Any]:
    name = next((row[key] for key in _IDS if key in row), None)
    number = flat(name)
    if name is not None and len(number) == 1 and number.dtype.kind in "iu":
        row["person"] = int(number[0])
    return row


def _stacked(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Tables (N, …) of what every row holds in the same shape."""
    fields: dict[str, Any] = {}
    for key in rows[0]:
        values = [row.get(key) for row in rows]
        if all(isinstance(value, (np.ndarray, np.generic, int, float)) for value in values):
            arrays = [np.asarray(value) for value in values]
            if len({array.shape for array in arrays}) == 1:
                fields[key] = np.stack(arrays)
    return fields
