"""The skin that fast cloth would fly into: contact for vertices that the nearest skin at t does not hold back.

Contact is found at x_t. The tangent plane there holds a vertex that stays near it; one that moves a long way past the body in a
step, or comes from beyond the reach of the search, meets skin that it was not matched with. The place where it would enter is
found here, on its straight way in free flight, and matched as a second contact.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hood.mesh.surface_tree import Match
from hood.scene.contact import Contact, Fold, find_fold, match_surface
from hood.scene.state import Obstacle

#: Vertices that move less than this [m] past the skin they are matched with are held by its tangent plane.
LEAST_WAY = 20e-3
#: Places on the way are no farther apart [m], as long as there are no more of them than so many: a step at 10 m/s and 30 fps.
STRIDE, MOST_PLACES = 15e-3, 24
#: A way ends where the cloth is nearer to the skin than this [m].
NEAR = 2e-3
#: And where the tangent plane that it has already is this much [m] farther off than the skin. Along a bulge it never is: that
#: plane is in front of the skin everywhere.
HIDDEN = 3e-3
#: Vertices deeper in the body at t than this [m] are on no way from outside.
INSIDE = 10e-3


def find_other_skin(pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, contact: Contact, flight: Tensor) -> Fold:
    """The skin besides the nearest that cloth at ``pos`` (V, 3) [m] has to be kept off: the other side of folds
    (:func:`hood.scene.contact.find_fold`), and where vertices would land (:func:`find_landing`), which come first."""
    fold = find_fold(pos, vertex_scene, obstacle, contact)
    if not len(obstacle.faces) or not len(pos):
        return fold
    landing = find_landing(pos, vertex_scene, obstacle, contact, flight)
    if landing is None:
        return fold
    match, lands = landing
    if fold.contact is None:
        return Fold(Contact(**match._asdict(), valid=lands))
    known = fold.contact
    row = {name: lands.view(-1, *(1,) * (values.ndim - 1)) for name, values in match._asdict().items()}
    both = {name: torch.where(row[name], values, getattr(known, name)) for name, values in match._asdict().items()}
    return Fold(Contact(**both, valid=lands | known.valid))


def find_landing(
    pos: Tensor, vertex_scene: Tensor, obstacle: Obstacle, contact: Contact, flight: Tensor
) -> tuple[Match, Tensor] | None:
    """Where vertices would enter the body, and which of them would, (V,) bool; None where none does.

    Args:
        pos: (V, 3) m, at t.
        contact: of the positions, valid or not.
        flight: (V, 3) m, what they would move in the step without any force but weight.

    Returns:
        Matches (V,), at t and t + 1; ``dist`` is that of ``pos`` to the tangent plane at t. Rows that do not enter are those
        of ``contact``.
    """
    way = flight - (contact.next_point - contact.point)
    length = way.norm(dim=1)
    far = (length > LEAST_WAY) & length.isfinite() & (contact.dist > -INSIDE) & (contact.dist - length < NEAR)
    rows = far.nonzero().squeeze(1)
    if not len(rows):
        return None
    # Every way has places of its own number; shorter ones end in copies of their last, so that no scene changes another's.
    counts = (length[rows] / STRIDE).ceil().clamp(1, MOST_PLACES).unsqueeze(1)
    count = int(counts.max())
    shares = torch.arange(1, count + 1, device=pos.device).minimum(counts) / counts
    places = pos[rows].unsqueeze(1) + shares.unsqueeze(2) * way[rows].unsqueeze(1)
    scenes = vertex_scene[rows].repeat_interleave(count)
    match = match_surface(places.reshape(-1, 3), scenes, obstacle, curved=True)
    plane = torch.where(contact.valid, (contact.point * contact.normal).sum(dim=1), -torch.inf)[rows].unsqueeze(1)
    off = (places * contact.normal[rows].unsqueeze(1)).sum(dim=2) - plane
    skin = match.dist.view(len(rows), count)
    touched = (skin < NEAR) & (off - skin > HIDDEN)
    first = touched.to(torch.int8).argmax(dim=1)  # the first of those that are touched
    place = count * torch.arange(len(rows), device=pos.device) + first
    point, normal = match.point[place], match.normal[place]
    dist = ((pos[rows] - point) * normal).sum(dim=1)
    keep = touched.any(dim=1) & ((normal * way[rows]).sum(dim=1) < 0) & (dist > 0)
    if not bool(keep.any()):
        return None
    chosen, found = rows[keep], match._asdict() | {"dist": match.dist.index_copy(0, place, dist)}
    both = {name: getattr(contact, name).index_copy(0, chosen, values[place[keep]]) for name, values in found.items()}
    return Match(**both), torch.zeros_like(contact.valid).index_fill(0, chosen, True)
