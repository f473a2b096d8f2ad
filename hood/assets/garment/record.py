"""A garment on its way from a file to a body, and the record of what was done to it.

Names for the connected parts of a file.

What is asked of a file that is not one sheet of cloth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hood.assets.formats.mesh_file import PART
from hood.assets.garment.garment import Garment
from hood.mesh.parts import MeshPart, part_labels
from hood.mesh.topology import connected_components


@dataclass
class Fitting:
    """A garment on its way from a file to a body, with a record of every change."""

    garment: Garment
    file: Garment  # as it was read
    vertex_map: np.ndarray  # (V of the file,) present number of each vertex of the file; -1: removed
    changes: list[Change] = field(default_factory=list)
    stitches: np.ndarray | None = None  # (S, 2) vertices of the file that its lines join

    def note(self, what: str, count: int, text: str, **details: Any) -> None:
        """Record a change of ``count`` things; nothing is recorded for none."""
        if count:
            self.changes.append(Change(what, count, text, details))

    def in_file(self, vertices: np.ndarray) -> np.ndarray:
        """Numbers in the file, of any shape, of vertices by their present numbers: of several that were joined the first."""
        first = np.full(len(self.garment.rest_pos), -1, dtype=np.int64)
        rows = np.flatnonzero(self.vertex_map >= 0)[::-1]
        first[self.vertex_map[rows]] = rows
        return np.asarray(first[vertices])

    def at_present(self, vertices: np.ndarray) -> np.ndarray:
        """(n,) present numbers of vertices of the file, without those that are gone."""
        present = self.vertex_map[vertices.reshape(-1)]
        return np.asarray(present[present >= 0])

    def guess(self, what: str, count: int, text: str, fix: str, **details: Any) -> None:
        """Record a change that rests on what the file seems to hold; ``fix`` is what says otherwise."""
        if count:
            self.changes.append(Change(what, count, text, details, fix))


@dataclass(frozen=True)
class Change:
    """One change: its name for programs, how many things it touched, and a sentence."""

    what: str
    count: int
    text: str
    details: dict[str, Any]
    fix: str = ""  # of a guess: what to do where it is wrong


def start_fitting(garment: Garment, stitches: np.ndarray | None = None) -> Fitting:
    """A fitting of a garment as it was read, with the pairs (S, 2) of vertices that lines of its file join."""
    return Fitting(garment, garment, np.arange(len(garment.rest_pos)), stitches=stitches)


#: A name is that of a part if it covers so much [share] of the part's faces.
_COVERED = 0.9


def own_names(garment: Garment, parts: list[MeshPart]) -> list[str | None]:
    """For every part the name of the first object, group or material that has all of it and not all of the file; None: the
    file gives it none."""
    panels = {name: mask for name, mask in (garment.panels or {}).items() if not mask.all()}
    return [next((name for name, mask in panels.items() if mask[part.faces].mean() >= _COVERED), None) for part in parts]


def names_of_parts(garment: Garment, parts: list[MeshPart]) -> list[str]:
    """A name for every part: its own, else its number; those that fasteners hold together have that of the first of them."""
    own = own_names(garment, parts)
    names = [(name or f"{PART}{part.number}").replace("+", "_") for name, part in zip(own, parts, strict=True)]
    rows = list((garment.fasteners or {}).values())
    if not rows:
        return names
    label = part_labels(len(garment.rest_pos), garment.faces)
    joined = connected_components(len(parts), label[np.concatenate(rows)])
    return [names[int(np.argmax(joined == own))] for own in joined]


#: Choices for cloth that has its thickness in the file, and for buttons and the like.
SHELLS, SMALL_PARTS = ("auto", "keep"), ("ride", "leave_out", "simulate")
#: What stands for the file's name in a sentence of one who does not know it.
FILE = "FILE"
#: Rims of pattern pieces within this [m] are sewn: 5 mm, and what curves add to it.
SEAM = 5.5e-3
#: Stitches of a file are closed up to this length [m]: longer ones are of pieces that were never draped.
THREAD = 0.02


@dataclass(frozen=True)
class Wanted:
    """Answers to what a file leaves open."""

    objects: tuple[str, ...] = ()  # names of objects, groups, materials or parts (part_1, …) that are the garment; (): all
    sew: bool = True  # rims that lie along each other
    gap: float | None = None  # m, within which rims are sewn; None: SEAM between pieces, none between garments
    shells: str = "auto"  # one of SHELLS: auto makes thick cloth one layer
    small_parts: str = "ride"  # one of SMALL_PARTS
    layered: bool = False  # an order of the garments was asked for
