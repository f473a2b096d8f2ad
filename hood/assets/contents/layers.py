"""Cloth that is in the file with its thickness, or twice, as one layer."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from hood.assets.contents.objects import SMALL, THICKEST
from hood.assets.fitting.alterations import drop_faces
from hood.assets.garment.record import Fitting
from hood.mesh.editing.shells import find_shell, paired_sheet, same_sheet
from hood.mesh.parts import MeshPart, find_parts

#: Copies of a sheet lie on it within this share of its size.
_COPY = 1e-6
#: Beyond so many parts of one file copies are not looked for: they are buttons and beads.
_MOST = 200
#: A closed part of less than this share of the largest one's area is a thing on the cloth.
_LARGE = 0.15
_KEEP = "shells=keep simulates what is in the file"


def drop_copies(fitting: Fitting) -> None:
    """Leave out parts that lie, face on face, on another part."""
    garment = fitting.garment
    pos, faces = garment.rest_pos, garment.faces
    parts, dropped = find_parts(pos, faces), np.zeros(len(faces), dtype=bool)
    for first, second in _near(parts):
        if dropped[first.faces[0]] or dropped[second.faces[0]]:
            continue
        large, small = (first, second) if len(first.faces) >= len(second.faces) else (second, first)
        if same_sheet(pos, faces[large.faces], faces[small.faces], _COPY * large.extent):
            dropped[small.faces] = True
    count = int(dropped.sum())
    drop_faces(fitting, ~dropped)
    fitting.note("copies", count, f"{count} faces lie on others with vertices of their own; the cloth is taken once ({_KEEP})")


def to_one_layer(fitting: Fitting, scale: float) -> None:
    """Closed shells, and sheets of one make that lie along each other, become their outer layer; how thick they are is kept."""
    garment = fitting.garment
    pos, faces = scale * garment.rest_pos, garment.faces
    parts = find_parts(pos, faces)
    dropped, thickness = np.zeros(len(faces), dtype=bool), np.zeros(len(pos))
    found: list[_Layers] = [*_shells(pos, faces, parts), *_pairs(pos, faces, parts)]
    for outer, others, thick in found:
        if not dropped[outer].any():
            dropped[others] = True
            thickness[np.unique(faces[outer])] = thick
    _tell_closed(fitting, parts, dropped)
    if not dropped.any():
        return
    own = garment.thickness
    drop_faces(fitting, ~dropped, thickness=thickness / scale if own is None else np.maximum(own, thickness / scale))
    apart = [value for _, _, value in found]
    text = f"cloth with its thickness, two layers {_range(apart)} apart; the outer layer is simulated"
    if max(apart) * 1e6 < 1.0:
        text = "cloth with two sides, two layers in one place; one is simulated"
    fitting.guess("layers", int(dropped.sum()), f"the file shows {text}", _KEEP, thickness=max(apart))


def _tell_closed(fitting: Fitting, parts: list[MeshPart], dropped: np.ndarray) -> None:
    """Say which large parts are closed and stay so."""
    largest = max(part.area for part in parts)
    closed = [part for part in parts if part.closed and part.extent > SMALL and part.area > _LARGE * largest]
    left = [part for part in closed if not dropped[part.faces].any()]
    if left:
        named = ", ".join(f"part {part.number} of {len(part.vertices)} vertices" for part in left[:3])
        what = f"{named} is closed, and no layers of cloth are found in it; it is simulated as it is"
        fitting.guess("closed", len(left), what, "export it as one sheet where it was made, or choose others (objects=[…])")


def _range(thick: list[float]) -> str:
    low, high = f"{1e3 * min(thick):.1f}", f"{1e3 * max(thick):.1f}"
    return f"{high} mm" if low == high else f"{low} to {high} mm"


#: Rows of the faces of the layer that stays and of the others, and the thickness [m].
_Layers = tuple[np.ndarray, np.ndarray, float]


def _shells(pos: np.ndarray, faces: np.ndarray, parts: list[MeshPart]) -> list[_Layers]:
    """Those of closed parts."""
    found: list[_Layers] = []
    for part in parts:
        shell = find_shell(pos, faces[part.faces], THICKEST) if part.closed and part.extent > SMALL else None
        if shell is not None:
            outer = part.faces[shell.outer]
            found.append((outer, np.setdiff1d(part.faces, outer), shell.thickness))
    return found


def _pairs(pos: np.ndarray, faces: np.ndarray, parts: list[MeshPart]) -> list[_Layers]:
    """Those of two open parts, one the other's lining and of its make."""
    found: list[_Layers] = []
    open_ones = [part for part in parts if not part.closed]
    for first, second in _near(open_ones):
        apart = paired_sheet(pos, faces[first.faces], faces[second.faces], THICKEST)
        if apart is not None:
            outer, inner = (first, second) if first.area >= second.area else (second, first)
            found.append((outer.faces, inner.faces, apart))
    return found


def _near(parts: list[MeshPart]) -> list[tuple[MeshPart, MeshPart]]:
    """Pairs whose boxes are about the same, or one in the other."""
    if len(parts) > _MOST:
        return []
    return [(one, other) for one, other in combinations(parts, 2) if _holds(one, other) or _holds(other, one)]


def _holds(one: MeshPart, other: MeshPart) -> bool:
    spare = THICKEST + 1e-3 * one.extent
    return bool((other.low >= one.low - spare).all() and (other.high <= one.high + spare).all())
