"""Garments that can be read and simulated and are none, or are not worn: each told in one sentence with its way out.

Nothing here changes or refuses anything; commands that would go on to a wrong result refuse what is ``grave``.

Whether a garment lies around a body where its file has it, so that nothing asks for another place, and the way there: what is
worn has a limb, the neck or the trunk in every opening.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hood.assets.fitting.placement import inward_share, surrounds
from hood.assets.garment.binding import closest_points, signed_distances
from hood.mesh import topology
from hood.mesh.editing import repair
from hood.mesh.parts import find_parts, rim_length

#: Shorter openings are buttonholes and slits [body heights]: a child's cuff has 0.1.
_LEAST_LENGTH = 0.07
#: Where an opening's span is looked at, from its middle to its rim; a tight cuff lies on the skin itself.
_SHARES = np.array([0.0, 0.25, 0.45, 0.6, 0.7, 0.8, 0.9, 0.97])


class Openings(NamedTuple):
    """Openings of the parts that have at least two: a sheet has its rim alone, and nobody is in it."""

    num: int
    num_empty: int  # those with no part of the body in them
    empty: tuple[np.ndarray, ...] = ()  # vertices (n,) around each of these


def find_openings(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> Openings:
    """How many openings of the garment ``pos`` (V, 3) [m], ``faces`` (F, 3) hold no part of a body ``surface`` (W, 3) [m].

    An opening is spanned by segments from its middle to its rim; it holds the body if one of them enters it.
    """
    least = _LEAST_LENGTH * float(np.ptp(surface, axis=0).max())
    loops = [loop for loop in topology.boundary_loops(faces) if rim_length(pos, loop) >= least]
    part = topology.connected_components(len(pos), topology.unique_edges(faces))
    count = np.bincount([part[loop[0]] for loop in loops], minlength=1) if loops else np.zeros(1, dtype=np.int64)
    loops = [loop for loop in loops if count[part[loop[0]]] > 1]
    holds = _hold([pos[loop] for loop in loops], surface, body_faces)
    empty = tuple(loop for loop, one in zip(loops, holds, strict=True) if not one)
    return Openings(len(loops), len(empty), empty)


def _hold(rims: list[np.ndarray], surface: np.ndarray, faces: np.ndarray) -> list[bool]:
    if not rims:
        return []
    spans = [rim.mean(axis=0) + _SHARES[:, None, None] * (rim - rim.mean(axis=0)) for rim in rims]
    inside = signed_distances(np.concatenate([span.reshape(-1, 3) for span in spans]), surface, faces) < 0
    starts = np.cumsum([0, *(len(_SHARES) * len(rim) for rim in rims[:-1])])
    return list(np.logical_or.reduceat(inside, starts).tolist())


#: A garment in its place has at most this share of its vertices inside the body, none deeper than this [m]: where a limb or
#: the trunk passes through a wall of cloth, it is deeper by more.
_MOST_INSIDE, _DEEPEST = 0.05, 0.02
#: Cloth that such a garment has on the sides opposite to its main side: one with openings, and a sheet. A cape far behind the
#: back has 0.22, see :func:`hood.assets.fitting.placement.surrounds`.
_LEAST_ROUND, _SHEET_ROUND = 0.3, 0.15
#: What is put above the head starts so high [m] over it.
_ABOVE = 0.02
#: Its middle vertex is nearer to the skin than this [m].
_FARTHEST = 0.35


def lies_in_place(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> bool:
    """Whether a garment ``pos`` (V, 3) [m], ``faces`` (F, 3) lies around the closed ``surface`` (W, 3) [m], ``body_faces``
    (G, 3): close, hardly inside, with a part of the body in every opening. Invariant to rigid motion of both."""
    around = surrounds(pos[np.unique(faces)], surface, body_faces)
    if around.middle > _FARTHEST or around.inside > _MOST_INSIDE or around.depth > _DEEPEST or around.roundness < _SHEET_ROUND:
        return False
    openings = find_openings(pos, faces, surface, body_faces)
    return openings.num_empty == 0 and (openings.num == 0 or around.roundness >= _LEAST_ROUND)


def way_there(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> np.ndarray:
    """The offset (3,) [m] that brings a garment ``pos`` (V, 3) [m], ``faces`` (F, 3) to a body (W, 3) [m], (G, 3), unturned.

    Along one axis or more its box gets the middle of the body's, or it goes above the head. Of these moves it is the shortest
    to a place where :func:`lies_in_place` holds; where none is, that with the fewest vertices inside.
    """
    box, body_box = (np.stack([points.min(axis=0), points.max(axis=0)]) for points in (pos[np.unique(faces)], surface))
    gap = body_box.mean(axis=0) - box.mean(axis=0)
    above = np.array([gap[0], body_box[1, 1] + _ABOVE - box[0, 1], gap[2]])
    moves = [gap * axes for axes in product((0.0, 1.0), repeat=3) if any(axes)] + [above]
    ranked = sorted(moves, key=lambda move: float(np.linalg.norm(move)))
    for move in ranked:
        if lies_in_place(pos + move, faces, surface, body_faces):
            return move
    near = [move for move in ranked if np.abs(move - gap)[[0, 2]].max() < _FARTHEST]
    return min(near, key=lambda move: int((signed_distances(pos + move, surface, body_faces) < 0).sum()))


#: A part is flat where its least extent is below this share of its greatest.
_FLAT = 0.01
#: With this share of its vertices on top of another one a mesh is triangles without seams: a UV-split garment has 0.05 to 0.3.
_TORN = 0.5
#: A closed mesh as large as this share of a body's height and as thick as that share is a body. Clothes with two sides are
#: thinner: twice volume over area is 0.006 body heights for 1 cm, a body has 0.04.
_BODY_SIZE, _BODY_THICKNESS = 0.8, 0.02
_SMALL_RIM = 0.1
#: A mesh nearer than this [body heights] to this share of the body's vertices, head, hands and feet included, is the body.
_ON_SKIN, _ALL_SKIN = 0.006, 0.95
#: Metres per unit of the files that bodies come in.
_UNITS = (1.0, 0.01, 0.001)
#: A sheet farther from the skin than this [m] in the middle does not lie on the body at first.
_FAR = 0.35
#: What is said of such a sheet; and parts beyond so many are not looked at one by one.
_FALLS, _PARTS = ", and falls from there", 30
#: A garment is inside out where the normals of more than this share of its area point to the body; those that are not have
#: 0 to 0.04 of it, clothes with two sides a half.
_INSIDE_OUT = 0.75
#: A shape is the mirror image of itself where this share of it is at most so far [m] from its image.
_MOST, _ALIKE = 0.9, 0.02
#: Such a garment with so many openings is worn beside the body where the two planes are farther than this [m] from each other.
_OPENINGS, _BESIDE = 3, 0.06


@dataclass(frozen=True)
class Suspicion:
    """What a garment seems to be, in words that follow its name, and what to do."""

    what: str
    fix: str
    grave: bool  # a simulation of it would mean nothing

    @property
    def sentence(self) -> str:
        return f"{self.what}; {self.fix}"


def suspect_seams(pos: np.ndarray, faces: np.ndarray) -> list[Suspicion]:
    """Whether a garment (V, 3), (F, 3) is torn along seams that double vertices; grave where it is loose triangles."""
    joined = len(pos) - len(repair.weld(pos, faces, repair.weld_tolerance(pos, faces)).kept)
    if not joined:
        return []
    parts = len(np.unique(topology.connected_components(len(pos), topology.unique_edges(faces))))
    what = f"is torn: {joined} of its {len(pos)} vertices lie on another one along open seams ({parts} parts)"
    return [Suspicion(what, "hood prepare garment=… joins them", joined > _TORN * len(pos))]


def suspect_kind(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray) -> list[Suspicion]:
    """Whether a garment (V, 3), (F, 3), of any unit and place, is none: flat pattern pieces, or a body.

    ``surface`` (W, 3) [m] is the body that would wear it. Seams are taken as sewn, and the unit as the size tells it.
    """
    welded = repair.weld(pos, faces, repair.weld_tolerance(pos, faces))
    pos, faces = pos[welded.kept], welded.vertex_map[faces]
    flat, num = _flat_parts(pos, faces)
    if flat == num > 1:
        what = f"is flat: all {num} of its parts lie in planes, as sewing patterns do, and nobody can wear them"
        return [Suspicion(what, "sew and drape it where it was made, and export the draped garment", True)]
    height = float(np.ptp(surface, axis=0).max())
    size = float(np.ptp(pos[np.unique(faces)], axis=0).max())
    factor = min(_UNITS, key=lambda unit: abs(np.log(max(unit * size, 1e-12) / height)))  # a body is as large as a body
    pos, size = factor * pos, factor * size
    if size < _BODY_SIZE * height:
        return []
    why = body_of(pos, faces, surface, height)
    return [] if why is None else [Suspicion(why, "pass it as body=…, and a garment with openings as garment=…", True)]


def body_of(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, height: float) -> str | None:
    """Why a mesh (V, 3) [m], (F, 3) as large as a person of that ``height`` [m] is a body, in words that follow "it"; None: it
    is none. ``surface`` (W, 3) [m] is the body that garments are measured against."""
    size = float(np.ptp(pos[np.unique(faces)], axis=0).max())
    if size < _BODY_SIZE * height:
        return None
    # Eyes and mouths may be open; the openings of a garment are longer.
    closed = all(rim_length(pos, loop) < _SMALL_RIM * height for loop in topology.boundary_loops(faces))
    if closed and _thickness(pos, faces) > _BODY_THICKNESS * height:
        return f"is a closed solid {size:.2f} m large, which is a body, not a garment"
    if float((cKDTree(pos).query(surface, distance_upper_bound=_ON_SKIN * height)[0] < np.inf).mean()) > _ALL_SKIN:
        return "lies on the skin of the whole body, head, hands and feet included: it is the body, not a garment"
    return None


def suspect_place(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> list[Suspicion]:
    """Whether a garment (V, 3) [m] is worn by the body (W, 3) [m] where both are; a sheet may lie anywhere.

    Grave: it surrounds nothing of the body, half of its openings are empty, as those of a shirt around the knees are, or they
    are around other limbs than they were made for. Of several parts, those that are away from the body, or around nothing of
    it, are told by their numbers.
    """
    whole = _suspect_whole(pos, faces, surface, body_faces) or suspect_limbs(pos, faces, surface, body_faces)
    parts = find_parts(pos, faces)
    if any(one.grave for one in whole) or len(parts) == 1 or len(parts) > _PARTS:
        return whole
    for part in parts:
        used, corners = np.unique(faces[part.faces], return_inverse=True)
        found = _suspect_whole(pos[used], corners.reshape(-1, 3), surface, body_faces)
        if any(one.grave for one in found) or any(one.what.endswith(_FALLS) for one in found):
            where = f"part {part.number} of {len(parts)}, {len(used)} vertices from {int(used[0])} on,"
            return [Suspicion(f"has a part that is not worn: {where} {found[0].what}", found[0].fix, False)]
    return whole


def _suspect_whole(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> list[Suspicion]:
    openings = find_openings(pos, faces, surface, body_faces)
    around = surrounds(pos, surface, body_faces)
    fix = "hood inspect says how to place it"
    if openings.num == 0:
        return [Suspicion(f"{around.problem}{_FALLS}", fix, False)] if around.middle > _FAR else []
    if openings.num_empty == openings.num:
        what = f"does not surround the body: none of its {openings.num} openings has a part of the body in it"
        return [Suspicion(f"{what} (half of it is over {around.middle:.2g} m away from the skin)", fix, True)]
    if openings.num_empty:
        what = (
            f"is not worn as it was made: {openings.num_empty} of its {openings.num} openings have no part of the body in them"
        )
        return [Suspicion(what, fix, 2 * openings.num_empty >= openings.num)]
    return []


def suspect_limbs(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> list[Suspicion]:
    """Whether a part of a garment (V, 3) [m] is beside the body (W, 3) [m], the head in an armhole: by the planes of symmetry
    of both, in a pose in which they have one."""
    parts = find_parts(pos, faces)
    for part in parts if len(parts) <= _PARTS else ():
        used, corners = np.unique(faces[part.faces], return_inverse=True)
        own = pos[used], corners.reshape(-1, 3)
        beside = abs(_middle(own[0]) - _middle(surface))
        if beside <= _BESIDE or not (_is_mirrored(*own) and _is_mirrored(surface, body_faces)):
            continue
        openings = find_openings(*own, surface, body_faces)
        if openings.num - openings.num_empty >= _OPENINGS:
            which = "" if len(parts) == 1 else f"has a part, of {len(used)} vertices from {int(used[0])} on, that "
            what = f"is {100 * beside:.0f} cm beside the body: its openings are around other limbs than they were made for"
            return [Suspicion(which + what, "hood inspect says how to place it", True)]
    return []


def _middle(pos: np.ndarray) -> float:
    """x [m] of the upright plane in the middle of the points (V, 3) [m]."""
    return 0.5 * float(pos[:, 0].min() + pos[:, 0].max())


def _is_mirrored(pos: np.ndarray, faces: np.ndarray) -> bool:
    """Whether the mesh (V, 3) [m], (F, 3) is its own image in the plane in its middle."""
    dist, _ = closest_points(pos * [-1.0, 1.0, 1.0] + [2.0 * _middle(pos), 0.0, 0.0], pos, faces)
    return float(np.quantile(np.abs(dist), _MOST)) <= _ALIKE


def suspect_sides(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> list[Suspicion]:
    """Whether a garment (V, 3) [m] is inside out on the body (W, 3) [m]; a sheet has no inside.

    The solver asks for no side; networks that look at normals, pictures and exports do.
    """
    share = inward_share(pos, faces, surface, body_faces)
    if share <= _INSIDE_OUT or find_openings(pos, faces, surface, body_faces).num == 0:
        return []
    what = (
        f"is inside out: the normals of {share:.0%} of its area point to the body, which networks take for the other side and "
        "pictures show"
    )
    return [Suspicion(what, "hood prepare garment=… turns it", False)]


def _flat_parts(pos: np.ndarray, faces: np.ndarray) -> tuple[int, int]:
    """Parts whose vertices lie in one plane, and parts in all."""
    part = topology.connected_components(len(pos), topology.unique_edges(faces))
    rows = [np.flatnonzero(part == number) for number in np.unique(part[faces[:, 0]])]
    spread = [np.linalg.svd(pos[row] - pos[row].mean(axis=0), compute_uv=False) for row in rows if len(row) > 3]
    return sum(bool(values[2] < _FLAT * values[0]) for values in spread), len(rows)


def _thickness(pos: np.ndarray, faces: np.ndarray) -> float:
    """Twice the volume over the area [m] of a closed mesh: the thickness of a sheet with two sides."""
    corners = pos[faces] - pos.mean(axis=0)
    volume = abs(float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))) / 6.0
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    return 2.0 * volume / max(float(area), 1e-12)
