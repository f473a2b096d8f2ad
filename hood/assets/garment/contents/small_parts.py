"""Buttons, buckles, eyelets, labels and pockets: parts that lie on cloth and ride on it, instead of falling from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from hood.assets.garment.alterations import Fitting, drop_faces
from hood.assets.garment.contents.objects import SMALL, num_openings
from hood.assets.garment.contents.wanted import Wanted
from hood.assets.garment.garment import Garment
from hood.mesh.parts import Part, find_parts
from hood.mesh.proximity import SurfaceHit, search_surface
from hood.mesh.riders import Riders, clusters, join_riders, rigid_anchors

#: A small thing is on the cloth if it is no farther off than this [m], a large solid one than half of it, and things no farther
#: apart than the last are one.
_ON, _ONE = 0.015, 0.002
#: A solid thing may be so large [m] and ride.
_LARGE = 0.4
#: A sheet lies on cloth with so much [share] of its vertices within this [m], and is at most such a share of its area.
_LYING, _NEAR, _SHARE = 0.9, 0.008, 0.15
#: Things in words: so many are named by their places.
_NAMED = 3


@dataclass(frozen=True)
class _Kinds:
    """The parts of a file by what becomes of them."""

    cloth: list[Part]
    rigid: list[Part]  # closed ones
    sheets: list[Part]  # pockets, labels
    off: list[Part]  # closed ones that lie on no cloth


def let_ride(fitting: Fitting, wanted: Wanted, scale: float) -> None:
    """Take what lies on the cloth out of the simulation: it rides, or is left out."""
    if wanted.small_parts == "simulate":
        return
    garment = fitting.garment
    pos, faces = scale * garment.rest_pos, garment.faces
    kinds = _sorted(pos, faces)
    taken = [*kinds.rigid, *kinds.sheets]
    if not taken and not kinds.off:
        return
    riders = None
    if wanted.small_parts == "ride" and taken:
        riders = _riders(garment, kinds, scale)
    kept = np.ones(len(faces), dtype=bool)
    for part in [*taken, *kinds.off]:
        kept[part.faces] = False
    fitting.garment = replace(garment, riders=riders)
    _note(fitting, kinds, wanted, pos)
    drop_faces(fitting, kept)


def _sorted(pos: np.ndarray, faces: np.ndarray) -> _Kinds:
    """The parts, by size, openings and what they lie on."""
    parts = find_parts(pos, faces)
    closed = [part for part in parts if part.closed and part.extent <= _LARGE]
    cloth = [part for part in parts if not (part.closed and part.extent <= _LARGE)]
    if not cloth or len(parts) == 1:
        return _Kinds(parts, [], [], [])
    largest = max(part.area for part in cloth)
    few = [part for part in cloth if part.area < _SHARE * largest and num_openings(pos, part) < 2]
    cloth = [part for part in cloth if not any(part is one for one in few)]
    on: list[Part] = []
    off: list[Part] = []
    for part, dist in zip(closed, _distances(pos, faces, cloth, closed), strict=True):
        (on if dist.min() <= (_ON if part.extent <= SMALL else 0.5 * _ON) else off).append(part)
    sheets: list[Part] = []
    for part, dist in zip(few, _distances(pos, faces, cloth, few), strict=True):
        (sheets if (dist <= _NEAR).mean() >= _LYING else cloth).append(part)
    return _Kinds(cloth, on, sheets, off)


def _distances(pos: np.ndarray, faces: np.ndarray, cloth: list[Part], parts: list[Part]) -> list[np.ndarray]:
    """Of every part the distances [m] of its vertices from the cloth."""
    if not parts:
        return []
    found = _below(pos, faces, cloth, np.concatenate([part.vertices for part in parts])).dist.abs().numpy()
    return np.split(found, np.cumsum([len(part.vertices) for part in parts])[:-1])


def _below(pos: np.ndarray, faces: np.ndarray, cloth: list[Part], vertices: np.ndarray) -> SurfaceHit:
    """Where vertices (n,) are nearest to the cloth; its faces count along those of all its parts, in their order."""
    table = torch.as_tensor(faces[np.concatenate([one.faces for one in cloth])])
    none = torch.zeros(max(len(pos), len(table)), dtype=torch.int64)
    points, places = torch.as_tensor(pos[vertices]), torch.as_tensor(pos)
    return search_surface(points, none[: len(points)], places, table, none[: len(pos)], none[: len(table)])


def _riders(garment: Garment, kinds: _Kinds, scale: float) -> Riders | None:
    """Rigid things by groups that touch, and the vertices of sheets one by one."""
    pos = scale * garment.rest_pos
    table = np.concatenate([part.faces for part in kinds.cloth])
    found: list[Riders | None] = [garment.riders]
    label = clusters([pos[part.vertices] for part in kinds.rigid], _ONE) if kinds.rigid else np.zeros(0, np.int64)
    for number in np.unique(label):
        members = [part for part, own in zip(kinds.rigid, label, strict=True) if own == number]
        hits = [_below(pos, garment.faces, kinds.cloth, part.vertices) for part in members]
        nearest = min(hits, key=lambda hit: float(hit.dist.abs().min()))
        corners = garment.faces[table[int(nearest.face[int(nearest.dist.abs().argmin())])]]
        own = next(part for part in kinds.cloth if np.isin(corners[0], part.vertices))
        vertices = np.concatenate([part.vertices for part in members])
        rows = own.vertices
        anchors = rows[rigid_anchors(pos[vertices], pos[rows], np.searchsorted(rows, corners))]
        found.append(_group(garment, members, anchors, np.zeros(len(anchors), np.int64), np.zeros(len(vertices), np.int64)))
    for part in kinds.sheets:
        corners = garment.faces[table[_below(pos, garment.faces, kinds.cloth, part.vertices).face.numpy()]]
        each = np.arange(len(part.vertices))
        found.append(_group(garment, [part], corners.reshape(-1), np.repeat(each, 3), each))
    return join_riders(found, [0] * len(found), [0] * len(found))


def _group(garment: Garment, parts: list[Part], anchors: np.ndarray, of_anchor: np.ndarray, of_rider: np.ndarray) -> Riders:
    vertices = np.concatenate([part.vertices for part in parts])
    rows = np.concatenate([part.faces for part in parts])
    order = np.argsort(vertices)
    faces = order[np.searchsorted(vertices[order], garment.faces[rows])]
    uv = None if garment.uv_faces is None else garment.uv_faces[rows]
    return Riders(garment.rest_pos[vertices], faces, of_rider, anchors, of_anchor, uv)


def _note(fitting: Fitting, kinds: _Kinds, wanted: Wanted, pos: np.ndarray) -> None:
    rides = wanted.small_parts == "ride"
    if kinds.rigid:
        many = len(kinds.rigid) > 1
        what = f"{_count(kinds.rigid, 'closed part')} on the cloth, as buttons are ({_places(kinds.rigid)})"
        kept = (
            "ride on it, each as one piece, outside the simulation"
            if many
            else "rides on it as one piece, outside the simulation"
        )
        other = "small_parts=leave_out leaves them out" if rides else "small_parts=ride keeps them"
        how = kept if rides else f"{'are' if many else 'is'} left out"
        fitting.guess("riding", len(kinds.rigid), f"{what} {how}", f"{other}, small_parts=simulate takes them for cloth")
    if kinds.sheets:
        count = _count(kinds.sheets, "sheet")
        what = f"{count} on the cloth, sewn to nothing, as pockets and labels are ({_places(kinds.sheets)})"
        how = "moved with it" if rides else "left out"
        fitting.guess("riding_sheets", len(kinds.sheets), f"{what}: {how}", "small_parts=simulate takes them for loose cloth")
    if kinds.off:
        what = f"{_count(kinds.off, 'closed part')} on no cloth ({_places(kinds.off)}): left out"
        fix = "objects=[…] chooses the garment, small_parts=simulate takes them for cloth"
        fitting.guess("off_cloth", len(kinds.off), what, fix)


def _count(parts: list[Part], noun: str) -> str:
    return f"{len(parts)} {noun}{'s' if len(parts) > 1 else ''}"


def _places(parts: list[Part]) -> str:
    """Which parts they are and where their middles lie, in units of the file, of the first few."""
    named = [f"{part_name(part)} at {np.round(0.5 * (part.low + part.high), 2).tolist()}" for part in parts[:_NAMED]]
    return ", ".join(named) + (f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else "")


def part_name(part: Part) -> str:
    return f"part {part.number} of {len(part.vertices)} vertices"
