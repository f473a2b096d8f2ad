"""What ``hood inspect`` says of a garment's file: its objects and parts, and what is made of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hood.assets.garment.contents.fitting import Change
from hood.assets.garment.contents.objects import Item, items_of, num_openings
from hood.assets.garment.contents.sort_out import metres_per_unit
from hood.assets.garment.contents.wanted import FILE
from hood.assets.garment.garment import Garment
from hood.mesh.parts import find_parts

#: What the defects of a mesh say already.
_KNOWN = ("welded", "removed_duplicate_faces", "objects")
#: Of a file with more parts they are counted, not listed.
_LISTED = 24


def describe_objects(garment: Garment, surface: np.ndarray) -> dict[str, Any]:
    """Facts on the objects of a file, or on its parts where it names none; nothing of a file that is one part without names."""
    scale = metres_per_unit(garment.rest_pos, garment.faces, surface)
    parts = find_parts(garment.rest_pos, garment.faces)
    if (len(parts) < 2 and not garment.panels) or (not garment.panels and len(parts) > _LISTED):
        return {}
    what = "object " if garment.panels else ""
    return {f"{what}{item.name}": _in_words(item) for item in items_of(garment, scale, surface)}


def describe_made(garment: Garment) -> dict[str, Any]:
    """Facts on what is made of a file: cloth, openings, thickness and what rides on it."""
    parts = find_parts(garment.rest_pos, garment.faces)
    thick = garment.thickness
    return {
        "thickness [mm]": None if thick is None or not thick.any() else round(1e3 * float(np.median(thick[thick > 0.0])), 2),
        "riding vertices": 0 if garment.riders is None else len(garment.riders.pos),
        "garments": None if garment.piece is None else garment.name.split("+"),
        "openings of each part": [num_openings(garment.rest_pos, part) for part in parts]
        if 1 < len(parts) <= _LISTED
        else None,
    }


def problems_of(file: str, changes: Sequence[Change]) -> list[tuple[str, str]]:
    """What is done to a file when it is read, with the key that says otherwise: a rollout does the same."""
    told = [change for change in changes if change.what not in _KNOWN]
    return [(change.text, change.fix.replace(FILE, file) or "a rollout does the same") for change in told]


def _in_words(item: Item) -> str:
    size = " × ".join(f"{side:.2g}" for side in item.size)
    return f"{item.num_vertices} vertices, {size} m, {item.seems}"
