"""Placements of a garment mesh beside a body, and whether it lies around it.

The unit of length of a garment file, guessed from its size beside the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.garment.binding import closest_points
from hood.assets.motion.skeleton import UP_AXES

#: A garment around the body has its middle vertex nearer to the skin than this [m] ...
_FARTHEST = 0.35
#: ... at most this share of its vertices inside the body ...
_MOST_INSIDE = 0.25
#: ... and at least this much cloth on the sides opposite to its main side: a cape on the back alone has 0.36.
_LEAST_ROUND = 0.3

#: Faces that are looked at to see where a garment's normals point, spread over its list of faces.
_LOOKED_AT = 4000

#: Rotations (3, 3) that turn the up axis of a file to y.
UPWARD = {axis: UP_AXES[axis] for axis in ("y", "z", "x")}


@dataclass(frozen=True)
class Placement:
    """How the coordinates of a garment's file become metres beside a body that stands at its origin and looks along +z."""

    scale: float  # metres per unit of the file
    up: str  # axis of the file that points up: a key of UP_AXES
    turn: float  # degrees about the vertical, counterclockwise from above, after the up axis is y
    offset: np.ndarray  # (3,) m, added last
    angle: float = 0.0  # degrees of the arms below the T-pose's

    def keys(self) -> list[str]:
        """The placement as keys of ``hood prepare``, to a tenth of a millimetre."""
        offset = ",".join(f"{round(float(value), 4) + 0.0:g}" for value in self.offset)
        return [f"scale={self.scale:g}", f"up={self.up}", f"turn={self.turn:g}", f"offset=[{offset}]"]

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) from the axes of the file to those of the body; exact for quarter turns."""
        return np.asarray(np.round(Rotation.from_euler("y", self.turn, degrees=True).as_matrix(), 15) @ UPWARD[self.up])

    def apply(self, pos: np.ndarray) -> np.ndarray:
        """``pos`` (V, 3), in units of the file, on the body [m]."""
        return self.scale * (pos @ self.rotation.T) + self.offset


class Surrounding(NamedTuple):
    """How a garment lies around a body."""

    inside: float  # share of its vertices inside the body, 0 to 1
    depth: float  # m, of the deepest of them
    middle: float  # m, median distance to the skin
    roundness: float  # 1: cloth on all sides of what it covers; 0: beside the body

    @property
    def problem(self) -> str | None:
        """Why it does not surround the body, in words that follow "the garment"; None: it does."""
        if self.middle > _FARTHEST:
            return f"is away from the body: its middle vertex is {self.middle:.2f} m from the skin"
        if self.inside > _MOST_INSIDE:
            return f"does not surround the body: {100 * self.inside:.0f}% of its vertices are inside it"
        if self.roundness < _LEAST_ROUND:
            return f"lies on one side of the body ({100 * self.roundness:.0f}% of a garment that goes around it)"
        return None


def surrounds(points: np.ndarray, surface: np.ndarray, faces: np.ndarray) -> Surrounding:
    """How the garment ``points`` (V, 3) [m] lies around the closed ``surface`` (W, 3) [m] with ``faces`` (G, 3).

    The directions from the skin to a garment that goes around a limb or the trunk cancel: ``roundness`` is one less the length
    of their mean. Invariant to rigid motion of both, and to the order of the vertices.
    """
    dist, closest = closest_points(points, surface, faces)
    away = (points - closest) * np.sign(dist)[:, None]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    return Surrounding(
        inside=float((dist < 0).mean()),
        depth=float(max(-dist.min(initial=0.0), 0.0)),
        middle=float(np.median(np.abs(dist))),
        roundness=1.0 - float(np.linalg.norm(away.mean(axis=0))),
    )


def inward_share(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> float:
    """Share of the area of the garment ``pos`` (V, 3) [m], ``faces`` (F, 3) whose normals point to the closed ``surface``
    (W, 3) [m] with ``body_faces`` (G, 3): about 0 for one worn as it was made, about 1 for one that is inside out."""
    some = faces[:: -(-len(faces) // _LOOKED_AT)] if len(faces) else faces
    corners = pos[some]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centre = corners.mean(axis=1)
    dist, closest = closest_points(centre, surface, body_faces)
    inward = ((centre - closest) * np.sign(dist)[:, None] * normal).sum(axis=1) < 0
    area = np.linalg.norm(normal, axis=1)
    return float(area[inward].sum() / max(float(area.sum()), 1e-30))


#: Metres per unit of files, by name.
LENGTH_UNITS = {1.0: "metres", 0.1: "decimetres", 0.0254: "inches", 0.01: "centimetres", 0.001: "millimetres"}
#: Metres per unit of the file that are tried when metres do not fit.
_FACTORS = {0.01: "centimetres", 0.001: "millimetres"}
#: Diagonals taken as they are, in body heights: from a baby's sock to a bridal train.
_POSSIBLE = (0.05, 3.0)
#: Diagonals that other units may give: one decade, from a sock to a wide dress, so that one unit fits at most.
_USUAL = (0.13, 1.3)


def size_ratio(pos: np.ndarray, body_pos: np.ndarray) -> float:
    """Diagonal of the garment's box over the body's largest extent."""
    return float(np.linalg.norm(np.ptp(pos, axis=0)) / max(np.ptp(body_pos, axis=0).max(), 1e-12))


def used(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The vertices (V', 3) that belong to faces: strays say nothing about a garment's size."""
    return pos[np.unique(faces)]


def find_scale(pos: np.ndarray, body_pos: np.ndarray) -> float | None:
    """Factor to metres of a garment ``pos`` (V, 3) made for a body ``body_pos`` (W, 3): 1, 0.01 or 0.001; None: none fits.

    1 whenever the size is possible as it is; where the garment lies plays no role.
    """
    ratio = size_ratio(pos, body_pos)
    if _POSSIBLE[0] <= ratio <= _POSSIBLE[1]:
        return 1.0
    return next((factor for factor in _FACTORS if _USUAL[0] <= ratio * factor < _USUAL[1]), None)


def possible(pos: np.ndarray, body_pos: np.ndarray) -> list[float]:
    """Units in which a garment ``pos`` (V, 3) has a usual size beside ``body_pos`` (W, 3); where none, a possible one."""
    ratio = size_ratio(pos, body_pos)
    usual = [unit for unit in LENGTH_UNITS if _USUAL[0] <= ratio * unit < _USUAL[1]]
    return usual or [unit for unit in LENGTH_UNITS if _POSSIBLE[0] <= ratio * unit <= _POSSIBLE[1]]


def require_metres(pos: np.ndarray, body_pos: np.ndarray, name: str) -> None:
    """Refuse a garment whose size shows that it is not in metres.

    Raises:
        ValueError: naming the units that it may be in, and the command that brings it to metres.
    """
    if find_scale(pos, body_pos) == 1.0:
        return
    size = f"garment {name!r} is {size_ratio(pos, body_pos):.3g} times the body's height"
    fitting = possible(pos, body_pos)
    if not fitting:
        raise ValueError(f"{size}; scale it to metres, hood prepare garment=… scale=FACTOR")
    if len(fitting) > 1:
        units = " or ".join(f"{LENGTH_UNITS[unit]} (scale={unit:g})" for unit in fitting)
        raise ValueError(f"{size}: it may be in {units}; hood prepare garment=… finds out which fits, hood inspect says it")
    (unit,) = fitting
    raise ValueError(
        f"{size}: it is in {LENGTH_UNITS[unit]}; multiply it by {unit:g}, hood prepare garment=… scale={unit:g} (or auto)"
    )
