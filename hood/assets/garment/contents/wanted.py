"""What is asked of a file that is not one sheet of cloth."""

from __future__ import annotations

from dataclasses import dataclass

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
