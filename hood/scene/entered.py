"""The skin that a step led into: contact for vertices that ended inside the body where none of their planes showed it.

The contact of a step is found at x_t. A vertex that is pulled a long way along the body, or that another limb reaches within
the step, can end in skin that it was not matched with. Where the step has led is known afterwards: the skin found there is a
second contact, with which the step is taken to its end again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from hood.mesh import surface_tree
from hood.mesh.proximity import build_incidence, search_surface
from hood.mesh.surface_tree import Match
from hood.scene.cloth import Cloth
from hood.scene.contact import Contact, Fold, match_surface
from hood.scene.state import Obstacle

#: Vertices no deeper than this [m] have not entered: contact gives way by some millimetres.
ENTERED_DEPTH = 4e-3
#: A plane shows skin that it is no farther in front of than this [m].
SHOWN = 3e-3
#: Deeper than this [m] the nearest skin says nothing about where a vertex came in.
DEEPEST = 50e-3


def find_entered(next_pos: Tensor, pos: Tensor, cloth: Cloth, obstacle: Obstacle, contacts: Sequence[Contact]) -> Fold | None:
    """The contacts of a step with the skin that its solution ``next_pos`` (V, 3) [m] lies in added; None where there is none.

    Args:
        pos: (V, 3) m, at t.
        contacts: what is known: the nearest skin, and the second contact of vertices that have one.
    """
    if not len(obstacle.faces) or not len(pos):
        return None
    depth = -signed_distance(next_pos, cloth.vertex_scene, obstacle.next_pos, obstacle)
    entered = cloth.free & (depth > ENTERED_DEPTH) & (depth < DEEPEST)
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
    return Fold(Contact(**both, valid=valid))


def signed_distance(pos: Tensor, vertex_scene: Tensor, surface: Tensor, obstacle: Obstacle) -> Tensor:
    """Signed distances [m] (V,) of positions (V, 3) to the obstacle with its vertices at ``surface`` (W, 3) [m]; infinite in
    scenes without any."""
    incidence = build_incidence(obstacle.faces, len(obstacle.pos))
    found = surface_tree.distance(pos, vertex_scene, surface, obstacle.faces, obstacle.face_scene, incidence.adjacency)
    if found is not None:
        return found
    return search_surface(pos, vertex_scene, surface, obstacle.faces, obstacle.vertex_scene, obstacle.face_scene).dist


def _match_at_end(next_pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle) -> Match:
    """The closest body points at t + 1 of positions (N, 3), and where they were at t."""
    back = replace(obstacle, pos=obstacle.next_pos, next_pos=obstacle.pos)
    match = match_surface(next_pos, vertex_scene, back, curved=True)
    return match._replace(point=match.next_point, normal=match.next_normal, next_point=match.point, next_normal=match.normal)
