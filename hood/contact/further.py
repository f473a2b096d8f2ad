"""Contact beyond that of the nearest skin at t: where fast cloth would land, where a step ended, where triangles cut the skin.

The skin that fast cloth would fly into: contact for vertices that the nearest skin at t does not hold back.

Contact is found at x_t. The tangent plane there holds a vertex that stays near it; one that moves a long way past the body in a
step, or comes from beyond the reach of the search, meets skin that it was not matched with. The place where it would enter is
found here, on its straight way in free flight, and matched as a second contact.

Cloth that is held farther off where a step left its triangles in the skin.

Contact acts at vertices, and how far off it holds them is an estimate of how deep the flat triangles between them chord error
(:mod:`hood.contact.sample_points`). Where cloth is heavy, very soft or coarse, or lands fast, the estimate can be too
small. Where a step has left triangles in the skin is known afterwards: their corners are held farther off, and the step is
taken to its end again.

The skin that a step led into: contact for vertices that ended inside the body where none of their planes showed it.

The contact of a step is found at x_t. A vertex that is pulled a long way along the body, or that another limb reaches within
the step, can end in skin that it was not matched with. Where the step has led is known afterwards: the skin found there is a
second contact, with which the step is taken to its end again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import Contact, SecondContact, find_second_contact, match_surface
from hood.mesh.closest_point import tree
from hood.mesh.closest_point.search import build_incidence, search_surface
from hood.mesh.closest_point.tree import Match
from hood.mesh.penetration.compiled import Eights, eights
from hood.mesh.penetration.crossing import crossings
from hood.tensors.batch import made_of

#: Vertices that move less than this [m] past the skin they are matched with are held by its tangent plane.
LEAST_WAY = 20e-3
#: Least distance [m] from one place on a way to the next, and how many places are looked at: a step at 10 m/s and 30 fps.
STRIDE, MOST_PLACES = 15e-3, 24
#: A way ends where the cloth is nearer to the skin than this [m].
_NEAR = 2e-3
#: And where the tangent plane that it has already is this much [m] farther off than the skin. Along a bulge it never is: that
#: plane is in front of the skin everywhere.
HIDDEN = 3e-3
#: Vertices deeper in the body at t than this [m] are on no way from outside.
INSIDE = 10e-3


def find_second_side(pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, contact: Contact, flight: Tensor) -> SecondContact:
    """The skin besides the nearest that cloth at ``pos`` (V, 3) [m] has to be kept off: the other side of folds
    (:func:`hood.contact.contact.find_second_contact`), and where vertices would land (:func:`find_landing`), which come
    first."""
    fold = find_second_contact(pos, vertex_scene, obstacle, contact)
    if not len(obstacle.faces) or not len(pos):
        return fold
    landing = find_landing(pos, vertex_scene, obstacle, contact, flight)
    if landing is None:
        return fold
    match, lands = landing
    if fold.contact is None:
        return SecondContact(Contact(**match._asdict(), valid=lands))
    known = fold.contact
    row = {name: lands.view(-1, *(1,) * (values.ndim - 1)) for name, values in match._asdict().items()}
    both = {name: torch.where(row[name], values, getattr(known, name)) for name, values in match._asdict().items()}
    return SecondContact(Contact(**both, valid=lands | known.valid))


def find_landing(
    pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, contact: Contact, flight: Tensor
) -> tuple[Match, Tensor] | None:
    """Where vertices would enter the body, and which of them would, (V,) bool; None where none does.

    Args:
        pos: (V, 3) m, at t.
        contact: of the positions, valid or not.
        flight: (V, 3) m, what they would move in the step without any force.

    Returns:
        Matches (V,), at t and t + 1; ``dist`` is that of ``pos`` to the tangent plane at t. Rows that do not enter are those
        of ``contact``.
    """
    way = flight - (contact.next_point - contact.point)
    length = way.norm(dim=1)
    far = (length > LEAST_WAY) & length.isfinite() & (contact.dist > -INSIDE) & (contact.dist - length < _NEAR)
    rows = far.nonzero().squeeze(1)
    if not len(rows):
        return None
    share = _first_touch(rows, pos, way, length, vertex_scene, obstacle, contact)
    rows = (share > 0.0).nonzero().squeeze(1)
    if not len(rows):
        return None
    places = pos[rows] + share[rows].unsqueeze(1) * way[rows]
    match = match_surface(places, vertex_scene[rows], obstacle, curved=True)
    dist = ((pos[rows] - match.point) * match.normal).sum(dim=1)
    keep = (((match.normal * way[rows]).sum(dim=1) < 0) & (dist > 0)).nonzero().squeeze(1)
    if not len(keep):
        return None
    chosen, found = rows[keep], match._asdict() | {"dist": dist}
    both = {name: getattr(contact, name).index_copy(0, chosen, values[keep]) for name, values in found.items()}
    return Match(**both), torch.zeros_like(contact.valid).index_fill(0, chosen, True)


def _first_touch(
    rows: Tensor, pos: Tensor, way: Tensor, length: Tensor, vertex_scene: Tensor, obstacle: Obstacle, contact: Contact
) -> Tensor:
    """The share of their ways (V,) at which vertices first touch skin that their tangent planes do not show; 0 where none does.

    Places follow each other by their distance from the skin, which is nowhere nearer in between, and by a stride at least. A
    way is left when what remains of it is shorter than that distance.
    """
    touched = torch.zeros_like(length)
    gone = contact.dist[rows].clamp_min(STRIDE).minimum(length[rows])
    for _ in range(MOST_PLACES):
        if not len(rows):
            break
        whole = length[rows]
        share = gone / whole
        places = pos[rows] + share.unsqueeze(1) * way[rows]
        skin = signed_distance(places, vertex_scene[rows], obstacle.pos, obstacle)
        plane = ((places - contact.point[rows]) * contact.normal[rows]).sum(dim=1)
        hidden = ~contact.valid[rows] | (plane - skin > HIDDEN)
        touches = (skin < _NEAR) & hidden
        if bool(touches.any()):
            touched = touched.index_copy(0, rows, torch.where(touches, share, 0.0))
        goes_on = ~touches & (skin < whole - gone + _NEAR) & (gone < whole)
        gone = (gone + skin.clamp_min(STRIDE)).minimum(whole)[goes_on]
        rows = rows[goes_on]
    return touched


#: Vertices no deeper than this [m] have not entered: contact gives way by some millimetres.
ENTERED_DEPTH = 4e-3
#: A plane shows skin that it is no farther in front of than this [m].
SHOWN = 3e-3
#: Deeper than this [m] the nearest skin says nothing about where a vertex came in.
_DEEPEST = 50e-3


def find_entered(
    next_pos: Tensor, pos: Tensor, cloth: Cloth, obstacle: Obstacle, contacts: Sequence[Contact]
) -> SecondContact | None:
    """The contacts of a step with the skin that its solution ``next_pos`` (V, 3) [m] lies in added; None where there is none.

    Args:
        pos: (V, 3) m, at t.
        contacts: what is known: the nearest skin, and the second contact of vertices that have one.
    """
    if not len(obstacle.faces) or not len(pos):
        return None
    dist = signed_distance(next_pos, cloth.vertex_scene, obstacle.next_pos, obstacle)
    if float(dist.min()) >= -ENTERED_DEPTH:
        return None
    depth = -dist
    entered = cloth.free & (depth > ENTERED_DEPTH) & (depth < _DEEPEST)
    for contact in contacts:
        if not bool(entered.any()):
            return None
        entered &= ~contact.valid | (contact.next_dist(next_pos) + depth > SHOWN)
    rows = entered.nonzero().squeeze(1)
    if not len(rows):
        return None
    match = _match_at_end(next_pos[rows], cloth.vertex_scene[rows], obstacle)
    match = match._replace(dist=((pos[rows] - match.point) * match.normal).sum(dim=1))
    known = contacts[-1]
    both = {name: getattr(known, name).index_copy(0, rows, values) for name, values in match._asdict().items()}
    valid = entered | known.valid if len(contacts) > 1 else entered
    return SecondContact(Contact(**both, valid=valid))


def signed_distance(pos: Tensor, vertex_scene: Tensor, surface: Tensor, obstacle: Obstacle) -> Tensor:
    """Signed distances [m] (V,) of positions (V, 3) to the obstacle with its vertices at ``surface`` (W, 3) [m]; infinite in
    scenes without any."""
    incidence = build_incidence(obstacle.faces, len(obstacle.pos))
    found = tree.distance(pos, vertex_scene, surface, obstacle.faces, obstacle.face_scene, incidence.adjacency)
    if found is not None:
        return found
    return search_surface(pos, vertex_scene, surface, obstacle.faces, obstacle.vertex_scene, obstacle.face_scene).dist


def _match_at_end(next_pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle) -> Match:
    """The closest body points at t + 1 of positions (N, 3), and where they were at t."""
    back = replace(obstacle, pos=obstacle.next_pos, next_pos=obstacle.pos)
    match = match_surface(next_pos, vertex_scene, back, curved=True)
    return match._replace(point=match.next_point, normal=match.next_normal, next_point=match.point, next_normal=match.normal)


#: Up to this share of a garment's triangles may be in the skin.
CUT_SHARE = 0.005
#: Corners of a triangle in the skin are held off by so much more [m], by twice as much where that was not enough, and by no
#: more than that in all.
RISE, MOST = 3e-3, 45e-3


def hold_off(
    next_pos: Tensor, cloth: Cloth, obstacle: Obstacle, contact: Contact, scenes: Tensor | None = None
) -> Contact | None:
    """The contact of a step that holds the triangles farther off that its solution ``next_pos`` (V, 3) [m] has left in the
    skin; None where these are few, or cannot be held farther off.

    Args:
        scenes: (B,) bool, where that may be done; None for everywhere.
    """
    cuts = _cut_faces(next_pos, cloth, obstacle)
    if not cuts:
        return None
    before = torch.zeros_like(contact.dist) if contact.raised is None else contact.raised
    rows = torch.zeros_like(contact.valid)
    for cut in cuts:
        rows[cut.reshape(-1)] = True
    after = (2.0 * before + RISE).clamp_max(MOST)
    rows &= contact.valid & cloth.free & (before + 0.5 * RISE < MOST)
    if scenes is not None:
        rows &= scenes[cloth.vertex_scene]
    return replace(contact, raised=torch.where(rows, after, before)) if bool(rows.any()) else None


def num_in_skin(next_pos: Tensor, cloth: Cloth, obstacle: Obstacle) -> Tensor:
    """Number (B,) int64 of the triangles of every scene that are in the skin at ``next_pos`` (V, 3) [m]."""
    return torch.tensor([len(cut) for _, cut in _cut(next_pos, cloth, obstacle)], device=next_pos.device)


def _cut_faces(next_pos: Tensor, cloth: Cloth, obstacle: Obstacle) -> list[Tensor]:
    """Corners (N, 3) of the triangles in the skin, of every scene that has more than :data:`CUT_SHARE`."""
    if not math.isfinite(float(next_pos.sum())):
        return []
    found = _cut(next_pos, cloth, obstacle)
    return [faces[torch.as_tensor(cut, device=faces.device)] for faces, cut in found if len(cut) > CUT_SHARE * len(faces)]


def _cut(next_pos: Tensor, cloth: Cloth, obstacle: Obstacle) -> list[tuple[Tensor, np.ndarray]]:
    """Faces (F, 3) of the cloth of every scene, and the numbers of those in the skin."""
    found = []
    pos, skin = next_pos.double().cpu().numpy(), obstacle.next_pos.double().cpu().numpy()
    for faces, body in _by_scene(cloth, obstacle):
        cut = np.empty(0, dtype=np.int64)
        if len(faces) and len(body):
            both = _ordered(faces, pos), _ordered(body, skin)
            given = None if both[0] is None or both[1] is None else (both[0], both[1])
            cut = np.unique(crossings(pos, faces.cpu().numpy(), skin, body.cpu().numpy(), given).pairs[:, 0])
        found.append((faces, cut))
    return found


def _by_scene(cloth: Cloth, obstacle: Obstacle) -> list[tuple[Tensor, Tensor]]:
    """Faces of the cloth and of the body of every scene; scenes lie in one place and must not be compared."""
    if cloth.num_scenes == 1:
        return [(cloth.faces, obstacle.faces)]
    ends = np.cumsum([0, *cloth.scene_sizes])
    scenes = enumerate(pairwise(ends))
    first = cloth.faces[:, 0]
    return [(cloth.faces[(first >= a) & (first < b)], obstacle.faces[obstacle.face_scene == n]) for n, (a, b) in scenes]


def _ordered(faces: Tensor, pos: np.ndarray) -> Eights | None:
    """The faces (F, 3) in the order of a search, kept as long as they live."""
    made = made_of(faces)
    if "eights" not in made:
        made["eights"] = eights(faces.cpu().numpy(), pos)
    found: Eights | None = made["eights"]
    return found
