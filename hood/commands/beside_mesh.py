"""Where a garment lies beside a mesh body, for ``hood inspect``: without joints, it must be given as it is worn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hood.assets.binding import signed_distances
from hood.assets.garment import Garment
from hood.assets.sequence import Z_UP_TO_Y_UP
from hood.assets.suspicions import suspect_place
from hood.assets.units import find_scale, size_ratio, used
from hood.scene.mesh_motion import MeshMotion, worn_pos

if TYPE_CHECKING:
    from hood.commands.findings import Finding

#: A garment turned by a quarter must lie this much nearer to the body to be taken for z-up.
_TURN_GAIN = 0.6


def place_beside_mesh(finding: Finding, garment: Garment, motion: MeshMotion, units: dict[float, str]) -> None:
    """Record units, up axis and place of ``garment`` beside the first frame of a mesh, or its rest pose where that is nearer.

    Args:
        units: names of the factors that :func:`hood.assets.units.find_scale` finds.
    """
    rest = motion.sequence.rest
    surfaces = [motion.points(0)] if rest is None else [motion.points(0), rest]
    pos = worn_pos(garment)
    factor = find_scale(used(pos, garment.faces), surfaces[0])
    finding.facts["size in body heights"] = float(f"{size_ratio(used(pos, garment.faces), surfaces[0]):.3g}")
    finding.facts["units"] = "unknown" if factor is None else units[factor]
    if factor is None:
        finding.problem("its size fits no unit", "scale=FACTOR, metres per unit", "scale=FACTOR")
        return
    if factor != 1.0:
        finding.problem(f"it is in {units[factor]}", f"scale={factor:g}, or scale=auto", f"scale={factor:g}")
    pos = pos * factor
    (middle, near), (turned_middle, near_turned) = (
        min((_middle(points, surface, motion.faces), row) for row, surface in enumerate(surfaces))
        for points in (pos, pos @ Z_UP_TO_Y_UP.T)
    )
    surface = surfaces[near]
    if middle > 0.03 and turned_middle < _TURN_GAIN * middle:
        finding.problem("it lies as if z were up", "up=z", "up=z")
        pos, surface = pos @ Z_UP_TO_Y_UP.T, surfaces[near_turned]
    dist = signed_distances(pos, surface, motion.faces)
    finding.facts["distance to the skin, median [m]"] = round(float(np.median(np.abs(dist))), 4)
    inside = finding.facts["vertices inside the body"] = int((dist < 0).sum())
    misplaced = suspect_place(pos, garment.faces, surface, motion.faces)
    for suspicion in misplaced:
        gap = np.round((surface.max(axis=0) + surface.min(axis=0) - pos.max(axis=0) - pos.min(axis=0)) / 2, 2)
        centred = f"offset={gap.tolist()}".replace(" ", "")
        finding.problem(f"it {suspicion.what}", f"move it to where it is worn; {centred} puts it into the body's middle")
    if inside and not misplaced:
        depth = -1e3 * float(dist.min())
        what = f"{inside} vertices ({100 * inside / len(dist):.1f}%) are inside the body, to {depth:.1f} mm"
        finding.problem(what, "prepare starts them outside, and the rest shape stays", "")


def _middle(pos: np.ndarray, surface: np.ndarray, faces: np.ndarray) -> float:
    return float(np.median(np.abs(signed_distances(pos, surface, faces))))
