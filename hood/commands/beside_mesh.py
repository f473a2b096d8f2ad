"""Where a garment lies beside a mesh body, for ``hood inspect``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hood.assets.garment.binding import signed_distances
from hood.assets.garment.fit_search import Asked
from hood.assets.garment.garment import Garment
from hood.assets.garment.in_place import way_there
from hood.assets.garment.suspicions import suspect_place, suspect_sides
from hood.assets.garment.units import UNITS, find_scale, size_ratio, used
from hood.commands.describe_place import describe_place
from hood.commands.placing import find_place_on_mesh
from hood.scene.mesh_motion import MeshMotion, wearable

if TYPE_CHECKING:
    from hood.commands.findings import Finding


def place_beside_mesh(finding: Finding, garment: Garment, motion: MeshMotion) -> None:
    """Record units, up axis, facing and place of ``garment`` on the first frame of a mesh, or on its rest pose where that is
    nearer: what ``hood prepare`` finds for itself. Where it finds no place, the garment is looked at where it is."""
    surfaces = [motion.points(0)] + ([] if motion.sequence.rest is None else [motion.sequence.rest])
    pos = garment.worn_pos
    ratio = size_ratio(used(pos, garment.faces), surfaces[0])
    found = find_place_on_mesh(garment, motion, Asked())
    if found is not None and (found.refusal is None or found.resized is not None):
        finding.facts |= {
            "size in body heights": float(f"{found.placement.scale * ratio:.3g}"),
            "units": UNITS.get(found.placement.scale, "unknown"),
            "misfit on the body, 0 to 1": round(found.misfit, 3),
        }
        describe_place(finding, found, motion.name, has_joints=False)
        pos = (found.placement if found.resized is None else found.resized.placement).apply(pos)
    else:
        factor = find_scale(used(pos, garment.faces), surfaces[0])
        guess = "" if found is None else "by its size alone: "
        finding.facts[f"{guess}size in body heights"] = float(f"{(factor or 1.0) * ratio:.3g}")
        finding.facts[f"{guess}units"] = "unknown" if factor is None else UNITS[factor]
        if factor is None:
            finding.problem("its size fits no unit", "give scale=FACTOR, metres per unit")
            finding.refused = True
            return
        if factor != 1.0:
            finding.problem(f"it is in {UNITS[factor]}", f"scale={factor:g}, or scale=auto", f"scale={factor:g}")
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
