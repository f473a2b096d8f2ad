"""Buttons, buckles, eyelets, labels and pockets: parts that lie on cloth and ride on it, instead of falling from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from hood.assets.contents.objects import SMALL, num_openings
from hood.assets.fitting.alterations import drop_faces
from hood.assets.garment.garment import Garment
from hood.assets.garment.record import Fitting, Wanted
from hood.mesh.closest_point.search import SurfaceHit, search_surface
from hood.mesh.parts import MeshPart, Riders, clusters, find_parts, join_riders, rigid_anchors

#: A thing is on the cloth if it is no farther off than this [m]; things no farther apart than the second are one, which is no
#: larger than the third; larger ones, such as belts, bend with the cloth.
_ON, _ONE, _RIGID = 0.015, 0.002, 0.1
#: What bends with the cloth has so much [share] of its vertices within this [m] of it; a pocket lies closer.
_LYING, _AROUND, _NEAR = 0.9, 0.03, 0.008
#: Of the area of the largest cloth a solid thing or a pocket has at most this share.
_SHARE = 0.15
#: Things in words: so many are named by their places.
_NAMED = 3


@dataclass(frozen=True)
class _Kinds:
    """The parts of a file by what becomes of them."""

    cloth: list[MeshPart]
    rigid: list[MeshPart]  # closed ones, small
    bent: list[MeshPart]  # closed ones that are long: belts, cords
    sheets: list[MeshPart]  # pockets, labels
    off: list[MeshPart]  # closed ones that lie on no cloth

    @property
    def riding(self) -> list[MeshPart]:
        return [*self.rigid, *self.bent, *self.sheets]


def let_ride(fitting: Fitting, wanted: Wanted, scale: float) -> None:
    """Take what lies on the cloth out of the simulation: it rides, or is left out."""
    if wanted.small_parts == "simulate":
        return
    garment = fitting.garment
    pos, faces = scale * garment.rest_pos, garment.faces
    fastened = [row.reshape(-1) for row in (garment.fasteners or {}).values()]
    kinds = _sorted(pos, faces, np.concatenate([np.zeros(0, dtype=np.int64), *fastened]))
    if not kinds.riding and not kinds.off:
        return
    riders = _riders(garment, kinds, scale) if wanted.small_parts == "ride" and kinds.riding else garment.riders
    kept = np.ones(len(faces), dtype=bool)
    for part in [*kinds.riding, *kinds.off]:
        kept[part.faces] = False
    fitting.garment = replace(garment, riders=riders)
    _note(fitting, kinds, wanted, pos)
    drop_faces(fitting, kept)


def _sorted(pos: np.ndarray, faces: np.ndarray, fastened: np.ndarray) -> _Kinds:
    """The parts, by size, openings and what they lie on; what has ``fastened`` vertices (n,) is cloth."""
    parts = find_parts(pos, faces)
    held = [part for part in parts if np.isin(part.vertices, fastened).any()]
    largest = max((part.area for part in parts if not part.closed), default=0.0)
    closed = [part for part in parts if part.closed and (part.extent <= SMALL or part.area <= _SHARE * largest)]
    few = [part for part in parts if not part.closed and part.area <= _SHARE * largest and num_openings(pos, part) < 2]
    closed, few = ([part for part in own if not any(part is one for one in held)] for own in (closed, few))
    cloth = [part for part in parts if not any(part is one for one in (*closed, *few))]
    if not cloth or len(parts) == 1:
        return _Kinds(parts, [], [], [], [])
    found = _Kinds(cloth, [], [], [], [])
    for part, dist in zip(closed, _distances(pos, faces, cloth, closed), strict=True):
        bends = part.extent > _RIGID and float((dist <= _AROUND).mean()) >= _LYING
        lies = part.extent <= _RIGID and dist.min() <= _ON
        (found.bent if bends else found.rigid if lies else found.off).append(part)
    loose: list[MeshPart] = []
    for part, dist in zip(few, _distances(pos, faces, cloth, few), strict=True):
        (found.sheets if (dist <= _NEAR).mean() >= _LYING else loose).append(part)
    cloth.extend(loose)
    return found


def _distances(pos: np.ndarray, faces: np.ndarray, cloth: list[MeshPart], parts: list[MeshPart]) -> list[np.ndarray]:
    """Of every part the distances [m] of its vertices from the cloth."""
    if not parts:
        return []
    found = _below(pos, faces, cloth, np.concatenate([part.vertices for part in parts])).dist.abs().numpy()
    return np.split(found, np.cumsum([len(part.vertices) for part in parts])[:-1])


def _below(pos: np.ndarray, faces: np.ndarray, cloth: list[MeshPart], vertices: np.ndarray) -> SurfaceHit:
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
    for members in _things(pos, kinds.rigid):
        hits = [_below(pos, garment.faces, kinds.cloth, part.vertices) for part in members]
        nearest = min(hits, key=lambda hit: float(hit.dist.abs().min()))
        corners = garment.faces[table[int(nearest.face[int(nearest.dist.abs().argmin())])]]
        rows = next(part.vertices for part in kinds.cloth if np.isin(corners[0], part.vertices))
        vertices = np.concatenate([part.vertices for part in members])
        anchors = rows[rigid_anchors(pos[vertices], pos[rows], np.searchsorted(rows, corners))]
        found.append(_group(garment, members, anchors, np.zeros(len(anchors), np.int64), np.zeros(len(vertices), np.int64)))
    for part in (*kinds.bent, *kinds.sheets):
        corners = garment.faces[table[_below(pos, garment.faces, kinds.cloth, part.vertices).face.numpy()]]
        each = np.arange(len(part.vertices))
        found.append(_group(garment, [part], corners.reshape(-1), np.repeat(each, 3), each))
    return join_riders(found, [0] * len(found), [0] * len(found))


def _things(pos: np.ndarray, parts: list[MeshPart]) -> list[list[MeshPart]]:
    """Parts that touch are one thing, as a buckle and its pin; the teeth of a zipper, which all touch, are not."""
    if not parts:
        return []
    label = clusters([pos[part.vertices] for part in parts], _ONE)
    things = [[part for part, own in zip(parts, label, strict=True) if own == number] for number in np.unique(label)]
    split: list[list[MeshPart]] = []
    for thing in things:
        box = np.max([part.high for part in thing], axis=0) - np.min([part.low for part in thing], axis=0)
        split += [thing] if box.max() <= _RIGID else [[part] for part in thing]
    return split


def _group(garment: Garment, parts: list[MeshPart], anchors: np.ndarray, of_anchor: np.ndarray, of_rider: np.ndarray) -> Riders:
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
    if kinds.bent:
        what = f"{_count(kinds.bent, 'long closed part')} on the cloth, as belts and cords are ({_places(kinds.bent)})"
        how = "moved with it, outside the simulation" if rides else "left out"
        fitting.guess("riding_bent", len(kinds.bent), f"{what}: {how}", "small_parts=simulate takes them for cloth")
    if kinds.sheets:
        count = _count(kinds.sheets, "sheet")
        what = f"{count} on the cloth, sewn to nothing, as pockets and labels are ({_places(kinds.sheets)})"
        how = "moved with it" if rides else "left out"
        fitting.guess("riding_sheets", len(kinds.sheets), f"{what}: {how}", "small_parts=simulate takes them for loose cloth")
    if kinds.off:
        what = f"{_count(kinds.off, 'closed part')} on no cloth ({_places(kinds.off)}): left out"
        fix = "objects=[…] chooses the garment, small_parts=simulate takes them for cloth"
        fitting.guess("off_cloth", len(kinds.off), what, fix)


def _count(parts: list[MeshPart], noun: str) -> str:
    return f"{len(parts)} {noun}{'s' if len(parts) > 1 else ''}"


def _places(parts: list[MeshPart]) -> str:
    """Which parts they are and where their middles lie [m], of the first few."""
    named = [f"{part_name(part)} at {np.round(0.5 * (part.low + part.high), 2).tolist()} m" for part in parts[:_NAMED]]
    return ", ".join(named) + (f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else "")


def part_name(part: MeshPart) -> str:
    return f"part {part.number} of {len(part.vertices)} vertices"
