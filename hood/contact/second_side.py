"""The skin that fast cloth would fly into: contact for vertices that the nearest skin at t does not hold back.

Contact is found at x_t. The tangent plane there holds a vertex that stays near it; one that moves a long way past the body in a
step, or comes from beyond the reach of the search, meets skin that it was not matched with. The place where it would enter is
found here, on its straight way in free flight, and matched as a second contact.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hood.cloth.state import Obstacle
from hood.contact.contact import Contact, SecondContact, find_second_contact, match_surface
from hood.mesh.closest_point.tree import Match

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
        places = pos[rows] + (gone / whole).unsqueeze(1) * way[rows]
        skin = match_surface(places, vertex_scene[rows], obstacle).dist
        plane = ((places - contact.point[rows]) * contact.normal[rows]).sum(dim=1)
        hidden = ~contact.valid[rows] | (plane - skin > HIDDEN)
        touches = (skin < _NEAR) & hidden
        touched = touched.index_copy(0, rows, torch.where(touches, gone / whole, 0.0))
        goes_on = ~touches & (skin < whole - gone + _NEAR) & (gone < whole)
        gone = (gone + skin.clamp_min(STRIDE)).minimum(whole)[goes_on]
        rows = rows[goes_on]
    return touched
