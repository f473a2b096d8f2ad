"""Several garments in one file, as an outfit.

Parts of one object that were one garment: cut, and moved away from each other.

Cloth that is in the file with its thickness, or twice, as one layer.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hood.assets.contents.objects import OPENING, SMALL, THICKEST
from hood.assets.fitting.alterations import drop_faces
from hood.assets.garment.garment import Garment
from hood.assets.garment.record import Fitting, Wanted, names_of_parts, own_names
from hood.mesh.editing.seams import find_rims, ways_out
from hood.mesh.editing.shells import find_shell, paired_sheet, same_sheet
from hood.mesh.parts import MeshPart, find_parts, rim_length

#: Lengths of two rims of one cut differ by at most this share.
_ALIKE = 0.15
#: This share of their vertices is at most so far [m] from the other rim.
_SHARE, _FAR = 0.9, 0.05
#: Cosine between the way out of a part across its rim and the way to the other rim, in the mean: a lining beside its garment
#: has 0, a hem over a waistband less.
_AHEAD = 0.4


class Gap(NamedTuple):
    """Two rims that face each other all along."""

    parts: tuple[int, int]  # places in the list of parts
    middle: float  # m, median distance
    widest: float  # m


def find_gaps(pos: np.ndarray, faces: np.ndarray, parts: list[MeshPart]) -> list[Gap]:
    """Gaps between ``parts`` of the mesh ``pos`` (V, 3) [m], ``faces`` (F, 3) that can be worn by themselves."""
    ways = ways_out(pos, find_rims(faces))
    rims = [
        (number, rim, length)
        for number, part in enumerate(parts)
        if part.can_be_put_on
        for rim in part.rims
        if (length := rim_length(pos, rim)) >= OPENING
    ]
    found = []
    for row, (one, rim, length) in enumerate(rims):
        for other, facing, its_length in rims[row + 1 :]:
            if one == other or min(length, its_length) < (1.0 - _ALIKE) * max(length, its_length):
                continue
            dist, there = cKDTree(pos[facing]).query(pos[rim])
            its_dist, here = cKDTree(pos[rim]).query(pos[facing])
            both = np.concatenate([dist, its_dist])
            ahead = _mean_cosine(ways[rim], pos[facing][there] - pos[rim])
            its_ahead = _mean_cosine(ways[facing], pos[rim][here] - pos[facing])
            if np.quantile(both, _SHARE) <= _FAR and min(ahead, its_ahead) > _AHEAD:
                found.append(Gap((one, other), float(np.median(both)), float(both.max())))
    return found


def _mean_cosine(unit: np.ndarray, other: np.ndarray) -> float:
    """Between unit vectors (n, 3) and others, in the mean."""
    return float(((unit * other).sum(axis=1) / np.maximum(np.linalg.norm(other, axis=1), 1e-30)).mean())


#: A file of more parts than these is one garment: they are beads, fringes, or loose triangles.
_MOST = 12
#: Parts smaller than this share of the largest one are no garments of their own.
_LEAST = 0.02


def tell_apart(fitting: Fitting, wanted: Wanted, scale: float) -> None:
    """Parts of a file that are left become garments of an outfit, with the names of their objects; parts of one object are one
    garment.

    Raises:
        ValueError: parts without names of their own were one garment, and nothing was asked that says what they are.
    """
    garment = fitting.garment
    if garment.piece is not None:
        return
    parts = find_parts(scale * garment.rest_pos, garment.faces)
    if len(parts) < 2:
        return
    names = names_of_parts(garment, parts)
    area = {name: sum(part.area for part, own in zip(parts, names, strict=True) if own == name) for name in names}
    large = [name for name in area if area[name] >= _LEAST * max(area.values())]
    if len(large) < 2 or len(large) > _MOST:
        if len(parts) > _MOST:
            fitting.guess(
                "parts",
                len(parts),
                f"the file has {len(parts)} parts that hang together by nothing",
                "weld=0.01 sews rims up to 1 cm apart, objects=[…] chooses",
            )
        return
    if wanted == replace(Wanted(), shells=wanted.shells, small_parts=wanted.small_parts):
        _refuse_cut_apart(garment, parts, names, scale)
    piece = np.full(len(garment.rest_pos), -1, dtype=np.int64)
    for part, name in zip(parts, names, strict=True):
        piece[part.vertices] = large.index(name) if name in large else 0
    fitting.garment = replace(garment, name="+".join(large), piece=np.maximum(piece, 0))
    counts = ", ".join(f"{name} ({int((piece == number).sum())} vertices)" for number, name in enumerate(large))
    worn = {name for part, name in zip(parts, names, strict=True) if part.can_be_put_on}
    if worn >= set(large):
        what = f"the file holds {len(large)} garments, {counts}; they are worn as an outfit"
        fix = "objects=[…] chooses, layers=[…] orders them from the body outwards"
    else:
        what = f"the file holds {len(large)} parts that hang together by nothing, {counts}; each is simulated by itself"
        fix = "objects=[…] chooses, weld=0.01 sews rims up to 1 cm apart, pins=… hold what would fall"
    fitting.guess("garments", len(large), what, fix, names=large)


def _refuse_cut_apart(garment: Garment, parts: list[MeshPart], names: list[str], scale: float) -> None:
    unnamed = [row for row, own in enumerate(own_names(garment, parts)) if own is None]
    found = find_gaps(scale * garment.rest_pos, garment.faces, [parts[row] for row in unnamed])
    gaps = [(gap, *(names[unnamed[row]] for row in gap.parts)) for gap in found]
    gaps = [row for row in gaps if row[1] != row[2]]
    if gaps:
        pairs = ", ".join(f"{one} and {other}" for _, one, other in gaps)
        middle, widest = (max(getattr(gap, key) for gap, _, _ in gaps) for key in ("middle", "widest"))
        raise ValueError(
            f"garment {garment.name!r}: {pairs} are one garment that is cut, or several that end in front of each other: their "
            f"rims face each other all along, {1e3 * middle:.0f} mm apart; weld={np.floor(1e3 * widest + 1.5) / 1e3:g} sews "
            "them, weld=none or objects=[…] takes them as garments of their own"
        )


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
