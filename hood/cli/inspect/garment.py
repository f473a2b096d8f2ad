"""Where a garment lies beside a mesh body, for ``hood inspect``.

What ``hood inspect`` says of a garment's file: its objects and parts, and what is made of it.

Sentences of ``hood inspect`` on a garment that does not lie on its body.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hood.app.scene.placing import explain_size, find_place_on_mesh
from hood.assets.contents.objects import Item, items_of, num_openings
from hood.assets.contents.sort_out import metres_per_unit
from hood.assets.fitting.fit_search import AskedFit, FoundFit
from hood.assets.fitting.placement import LENGTH_UNITS, find_scale, size_ratio, used
from hood.assets.fitting.suspicions import suspect_place, suspect_sides, way_there
from hood.assets.garment.binding import signed_distances
from hood.assets.garment.garment import Garment
from hood.assets.garment.record import FILE, Change
from hood.mesh.parts import find_parts
from hood.scene.body_motion.mesh_motion import MeshMotion, wearable

if TYPE_CHECKING:
    from hood.cli.inspect.findings import Finding


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


def describe_place(finding: Finding, found: FoundFit, wearer: str, has_joints: bool = True) -> None:
    """What keeps the garment from lying where it belongs, and the keys that put it there, all of them where one is needed.

    ``has_joints``: prepare takes a pose for the body ``wearer``; a mesh has one.
    """
    placement = found.placement if found.resized is None else found.resized.placement
    scale, up, turn, offset = placement.keys()
    far, unit = float(np.linalg.norm(placement.offset)), found.placement.scale
    problems = (
        (unit != 1.0, f"it is in {LENGTH_UNITS.get(unit, 'another unit')}", found.placement.keys()[0]),
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


def place_beside_mesh(finding: Finding, garment: Garment, motion: MeshMotion) -> None:
    """Record units, up axis, facing and place of ``garment`` on the first frame of a mesh, or on its rest pose where that is
    nearer: what ``hood prepare`` finds for itself. Where it finds no place, the garment is looked at where it is."""
    surfaces = [motion.points(0)] + ([] if motion.sequence.rest is None else [motion.sequence.rest])
    pos = garment.worn_pos
    ratio = size_ratio(used(pos, garment.faces), surfaces[0])
    found = find_place_on_mesh(garment, motion, AskedFit())
    if found is not None and (found.refusal is None or found.resized is not None):
        finding.facts |= {
            "size in body heights": float(f"{found.placement.scale * ratio:.3g}"),
            "units": LENGTH_UNITS.get(found.placement.scale, "unknown"),
            "misfit on the body, 0 to 1": round(found.misfit, 3),
        }
        describe_place(finding, found, motion.name, has_joints=False)
        pos = (found.placement if found.resized is None else found.resized.placement).apply(pos)
    else:
        factor = find_scale(used(pos, garment.faces), surfaces[0])
        guess = "" if found is None else "by its size alone: "
        finding.facts[f"{guess}size in body heights"] = float(f"{(factor or 1.0) * ratio:.3g}")
        finding.facts[f"{guess}units"] = "unknown" if factor is None else LENGTH_UNITS[factor]
        if factor is None:
            finding.problem("its size fits no unit", "give scale=FACTOR, metres per unit")
            finding.refused = True
            return
        if factor != 1.0:
            finding.problem(f"it is in {LENGTH_UNITS[factor]}", f"scale={factor:g}, or scale=auto", f"scale={factor:g}")
        pos = factor * pos
    dist, surface = min(
        ((signed_distances(pos, surface, motion.faces), surface) for surface in surfaces),
        key=lambda pair: float(np.median(np.abs(pair[0]))),
    )
    finding.facts["distance to the skin, median [m]"] = round(float(np.median(np.abs(dist))), 4)
    inside = finding.facts["vertices inside the body"] = int((dist < 0).sum())
    misplaced = suspect_place(pos, garment.faces, surface, motion.faces)
    for suspicion in misplaced:
        way = np.round(way_there(pos, garment.faces, surface, motion.faces), 2) + 0.0
        offset = f"offset={way.tolist()}".replace(" ", "")
        moved = found is None and bool(way.any()) and not wearable(garment)  # of a sheet prepare changes nothing else
        fix = f"move it to where it is worn; {offset} brings it to the body"
        finding.problem(f"it {suspicion.what}", fix, offset if moved else None)
    finding.refused = any(suspicion.grave for suspicion in misplaced)
    for suspicion in [] if misplaced else suspect_sides(pos, garment.faces, surface, motion.faces):
        finding.problem(f"it {suspicion.what}", "prepare turns it", "")
    if inside and not misplaced:
        depth = -1e3 * float(dist.min())
        what = f"{inside} vertices ({100 * inside / len(dist):.1f}%) are inside the body, to {depth:.1f} mm"
        finding.problem(what, "prepare starts them outside, and the rest shape stays", "")
