"""Sentences of ``hood inspect`` on a garment that does not lie on its body."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hood.assets.garment.fit_search import Found
from hood.assets.garment.units import UNITS
from hood.commands.placing import explain_size

if TYPE_CHECKING:
    from hood.commands.findings import Finding


def describe_place(finding: Finding, found: Found, wearer: str, has_joints: bool = True) -> None:
    """What keeps the garment from lying where it belongs, and the keys that put it there, all of them where one is needed.

    ``has_joints``: prepare takes a pose for the body ``wearer``; a mesh has one.
    """
    placement = found.placement if found.resized is None else found.resized.placement
    scale, up, turn, offset = placement.keys()
    far, unit = float(np.linalg.norm(placement.offset)), found.placement.scale
    problems = (
        (unit != 1.0, f"it is in {UNITS.get(unit, 'another unit')}", found.placement.keys()[0]),
        (placement.up != "y", f"it lies as if {placement.up} were up", up),
        (placement.turn != 0, f"it faces {placement.turn:g} degrees away from {wearer!r}", turn),
        (far > 0, f"it is {far:.2f} m away from where it fits {wearer!r}", offset),
        (placement.angle != 0, f"its arms hang {placement.angle:g} degrees below the T-pose's", f"pose={placement.angle:g}"),
    )
    wrong = [(what, key) for is_so, what, key in problems if is_so]
    for what, key in wrong:
        finding.problem(what, f"{key}, or leave it to prepare")
    if found.resized is not None:
        what, fix = explain_size(found.resized)
        finding.problem(f"it {what}", fix)
    if wrong or found.resized is not None:
        finding.repairs += [scale, up, turn, offset, *([problems[-1][2]] if has_joints else [])]
