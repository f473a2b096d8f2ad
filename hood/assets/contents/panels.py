"""Pattern pieces whose rims lie along each other, sewn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hood.assets.contents.objects import num_openings
from hood.assets.fitting.alterations import keep_vertices
from hood.assets.garment.garment import Garment
from hood.assets.garment.record import SEAM, THREAD, Fitting, Wanted, own_names
from hood.mesh.editing import repair
from hood.mesh.editing.seams import Cut, Facing, Rims, Seam, along, along_corners, cut_edges, find_facing, find_rims
from hood.mesh.flat import SIDE_TABLES
from hood.mesh.parts import MeshPart, find_parts, part_labels, rim_length
from hood.mesh.topology import unique_edges

#: Two worn parts without names are one that was cut where so much [share] of the shorter rim lies along the other one, and so
#: much of that in front of it. Halves of clothes have 0.28 and 0.89 at least; a hem that crosses a waistband has 0.13 of the
#: rim or 0.75 in front at most.
_CUT, _IN_FRONT = 0.2, 0.8
#: A part with one rim is a bag, such as a sock, where its area is so many times that of a disc with this rim: the crown of a
#: hat has 3 to 5, a glove 20.
_BAG = 6.0


def sew_panels(fitting: Fitting, wanted: Wanted, scale: float, open_edges: np.ndarray) -> None:
    """Sew rims of pattern pieces within the gap; they are pulled together half way each.

    Two parts that are worn by themselves, each a bag or with two openings at least, are two garments, unless the gap is given
    or they have no names and end in front of each other, as the halves of a shirt do and a hem over a waistband does not.
    Vertices ``open_edges`` of the file, and those of fasteners, are left as they are.
    """
    gap = SEAM if wanted.gap is None else wanted.gap
    for _ in range(2):  # what was sewn to its neighbours may then be sewn to itself
        if not _sew_once(fitting, gap, wanted.gap is not None, scale, open_edges):
            break


def sew_stitches(fitting: Fitting, scale: float) -> None:
    """Make one vertex, in the middle, of two on rims that a line of the file joins; lines along the mesh mean nothing."""
    if fitting.stitches is None:
        return
    garment, ends = fitting.garment, fitting.vertex_map[fitting.stitches]
    ends = ends[(ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])]
    rims, known = find_rims(garment.faces).vertices, unique_edges(garment.faces)
    key = np.array([len(garment.rest_pos), 1])
    ends = ends[np.isin(ends, rims).all(axis=1) & ~np.isin(np.sort(ends, axis=1) @ key, known @ key)]
    apart = scale * np.linalg.norm(garment.rest_pos[ends[:, 0]] - garment.rest_pos[ends[:, 1]], axis=1)
    near = apart <= THREAD
    if near.any():
        _make_one(fitting, garment, ends[near])
        fitting.note("stitches", int(near.sum()), f"sewed {int(near.sum())} pairs of vertices that the file stitches")
    if not near.all():
        fitting.guess(
            "open_stitches", int((~near).sum()),
            f"{int((~near).sum())} stitches are longer than {1e3 * THREAD:g} mm, one {apart.max():.2f} m, and are left open",
            "drape the garment where it was made, until they are closed",
        )  # fmt: skip


def _sew_once(fitting: Fitting, gap: float, asked: bool, scale: float, open_edges: np.ndarray) -> bool:
    garment = fitting.garment
    pos = scale * garment.rest_pos
    parts, label = find_parts(pos, garment.faces), part_labels(len(pos), garment.faces)
    rims = find_rims(garment.faces)
    sides = [fitting.at_present(open_edges), *(row.reshape(-1) for row in (garment.fasteners or {}).values())]
    if len(rims.edges) == 0:
        return False
    pieces = _Pieces(pos, garment, parts, asked)
    facing = find_facing(pos, rims, label, gap, pieces.are_sewn, own=asked or len(parts) > 1, left_out=np.concatenate(sides))
    if not len(facing.pairs) and not len(facing.cut):
        return False
    between = {part for seam in facing.seams for part in seam.parts}
    _close(fitting, facing, rims)
    count, widest = len(facing.pairs) + len(facing.cut), max(seam.gap for seam in facing.seams)
    length = sum(seam.length for seam in facing.seams)
    fitting.guess(
        "panels", count,
        f"rims of {_pieces(len(between))} lie along each other, {1e3 * widest:.1f} mm apart, over {length:.2f} m, and are sewn",
        "weld=none leaves them open", pieces=len(between), gap=widest,
    )  # fmt: skip
    return True


def _pieces(count: int) -> str:
    return f"{count} pieces" if count > 1 else "one piece"


class _Pieces:
    """Which parts of a file are pieces of one garment."""

    def __init__(self, pos: np.ndarray, garment: Garment, parts: list[MeshPart], asked: bool) -> None:
        self._named = [name is not None for name in own_names(garment, parts)]
        self._worn = [num_openings(pos, part) >= 2 or _is_bag(pos, part) for part in parts]
        self._asked, self._several = asked, len(parts) > 1

    def are_sewn(self, seam: Seam) -> bool:
        """Whether a seam is one of a pattern, and not two rims that happen to be near each other."""
        one, other = seam.parts
        if self._asked:
            return True
        if one == other:  # a sleeve whose own edges meet; the open front of a jacket that is all there is stays open
            return self._several and not self._worn[one]
        if not (self._worn[one] and self._worn[other]):
            return True
        cut = seam.share >= _CUT and seam.in_front >= _IN_FRONT
        return not (self._named[one] and self._named[other]) and cut


def _is_bag(pos: np.ndarray, part: MeshPart) -> bool:
    return len(part.rims) == 1 and 4.0 * np.pi * part.area >= _BAG * rim_length(pos, part.rims[0]) ** 2


def _close(fitting: Fitting, facing: Facing, rims: Rims) -> None:
    """Cut edges where vertices face their inside, and make one vertex, in the middle, of those that face each other."""
    garment = fitting.garment
    count = len(garment.rest_pos)
    cut = cut_edges(garment.faces, count, rims.face[facing.cut[:, 1]], rims.corner[facing.cut[:, 1]], facing.at)
    garment = _with_cut(garment, cut)
    new = count + np.arange(len(facing.cut))
    _make_one(fitting, garment, np.concatenate([facing.pairs, np.stack([facing.cut[:, 0], new], axis=1)]))


def _make_one(fitting: Fitting, garment: Garment, pairs: np.ndarray) -> None:
    """``garment`` with vertices that ``pairs`` (N, 2) join as one, in the middle of them."""
    merged = repair.merge(len(garment.rest_pos), pairs)
    number = np.bincount(merged.vertex_map)
    middle = np.zeros((len(merged.kept), 3))
    np.add.at(middle, merged.vertex_map, garment.rest_pos)
    faces = merged.vertex_map[garment.faces]
    garment = keep_vertices(garment, faces, merged.kept, merged.vertex_map)
    whole = np.where((number > 1)[:, None], middle / number[:, None], garment.rest_pos)
    fitting.garment = replace(garment, rest_pos=whole)
    fitting.vertex_map = np.where(fitting.vertex_map < 0, -1, merged.vertex_map[fitting.vertex_map])


def _with_cut(garment: Garment, cut: Cut) -> Garment:
    """The garment with the new vertices; what its vertices and corners carry is linear along the edges. Faces that are cut lose
    what their sides carry."""
    rows: dict[str, Any] = {"rest_pos": along(cut, garment.rest_pos), "pinned": along(cut, garment.pinned)}
    if len(cut.ends):
        rows["region"] = None  # marks of the file's vertices
    for key in ("colours", "thickness", "stiffness"):
        if getattr(garment, key) is not None:
            rows[key] = along(cut, getattr(garment, key))
    if garment.uv is not None and garment.uv_faces is not None:
        rows["uv_faces"], rows["uv"] = along_corners(cut, garment.uv_faces, garment.uv)
    if garment.flat is not None:
        corners, values = along_corners(cut, np.arange(3 * len(garment.flat)).reshape(-1, 3), garment.flat.reshape(-1, 2))
        rows["flat"] = values[corners]
    whole = (cut.corners == np.arange(garment.faces.size).reshape(-1, 3)[cut.parent]).all(axis=1, keepdims=True)
    for key, plain in SIDE_TABLES.items():
        if getattr(garment, key) is not None:
            rows[key] = np.where(whole, getattr(garment, key)[cut.parent], plain)
    panels = {name: mask[cut.parent] for name, mask in (garment.panels or {}).items()} or None
    return replace(garment, **rows, faces=cut.faces, panels=panels, normal_faces=_corner_marks(garment, cut))


def _corner_marks(garment: Garment, cut: Cut) -> np.ndarray | None:
    """Corners that share a normal: at a new vertex none does."""
    if garment.normal_faces is None:
        return None
    marks, added = garment.normal_faces.reshape(-1), len(cut.sources) - garment.normal_faces.size
    return np.concatenate([marks, int(marks.max(initial=0)) + 1 + np.arange(added)])[cut.corners]
