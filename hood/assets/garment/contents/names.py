"""Names for the connected parts of a file."""

from __future__ import annotations

import numpy as np

from hood.assets.formats.objects import PART
from hood.assets.garment.garment import Garment
from hood.mesh.parts import Part, part_labels
from hood.mesh.topology import connected_components

#: A name is that of a part if it covers so much [share] of the part's faces.
_COVERED = 0.9


def own_names(garment: Garment, parts: list[Part]) -> list[str | None]:
    """For every part the name of the first object, group or material that has all of it and not all of the file; None: the
    file gives it none."""
    panels = {name: mask for name, mask in (garment.panels or {}).items() if not mask.all()}
    return [next((name for name, mask in panels.items() if mask[part.faces].mean() >= _COVERED), None) for part in parts]


def names_of(garment: Garment, parts: list[Part]) -> list[str]:
    """A name for every part: its own, else its number; those that fasteners hold together have that of the first of them."""
    own = own_names(garment, parts)
    names = [(name or f"{PART}{part.number}").replace("+", "_") for name, part in zip(own, parts, strict=True)]
    rows = list((garment.fasteners or {}).values())
    if not rows:
        return names
    label = part_labels(len(garment.rest_pos), garment.faces)
    joined = connected_components(len(parts), label[np.concatenate(rows)])
    return [names[int(np.argmax(joined == own))] for own in joined]
