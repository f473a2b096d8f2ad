"""How far off the body contact holds the cloth's vertices so that the flat triangles between them stay off it as well."""

from __future__ import annotations

import weakref

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.contact.contact import Contact

#: ``curvature``: farther where the body bulges under long edges; ``constant``: the same everywhere.
REACHES = ("curvature", "constant")
#: How much of L² κ vertices are held off: an eighth for the edges; triangles chord error more, and their corners differ.
SAG_SHARE = 1.5 / 8.0
#: Squares of edges that have grown by up to this factor, 12% in length, change nothing.
COVERED = 1.25
#: They are held off by no more [m] than this beside the constant part.
MOST_SAG = 8e-3
#: And by no more [m] than this beside that where they are stretched.
MOST_STRETCHED = 8e-3


def chord_error(cloth: Cloth, contact: Contact, pos: Tensor) -> Tensor:
    """How much farther off the skin [m] (V,) vertices have to be for the triangles between them: min(1.5 L² κ/8, 8 mm).

    An edge of length L whose ends are at a bulge of curvature κ cuts L² κ/8 deep into it. L² is the mean square of the rest
    lengths of the edges at the vertex, κ the body's curvature where the vertex was matched (:mod:`hood.mesh.geometry`).
    Fades with the square of the edges: 3.8 mm for 35 mm on a limb 120 mm thick, 0.9 mm for 17 mm.

    An edge that is stretched sags farther. What its square has grown by, beyond the quarter that the half more in
    :data:`SAG_SHARE` covers (:data:`COVERED`), is added to L², of the edge at the vertex that has grown most; no
    more than :data:`MOST_STRETCHED`, since cloth that is held farther off is stretched the more. Where a step has shown that it
    takes more (:mod:`hood.contact.further`), that is added.

    Args:
        pos: (V, 3) m, of the cloth at t.
    """
    share = SAG_SHARE * contact.curvature
    at_rest = (share * cloth.edge_length_sq).clamp_max(MOST_SAG)
    at_rest = at_rest if contact.raised is None else at_rest + contact.raised
    growth = _known_growth(cloth, pos)
    return at_rest if growth is None else at_rest + (share * growth).clamp_max(MOST_STRETCHED)


#: Cloth and positions that growth was asked of last, and what it was: both sides of a fold ask in turn.
_LAST: list[tuple[weakref.ref[Cloth], weakref.ref[Tensor], int, Tensor | None]] = []


def _known_growth(cloth: Cloth, pos: Tensor) -> Tensor | None:
    if pos.requires_grad or pos.is_inference():
        return _growth(cloth, pos)
    for of, at, version, value in _LAST:
        if of() is cloth and at() is pos and version == pos._version:
            return value
    value = _growth(cloth, pos)
    _LAST[:] = [(weakref.ref(cloth), weakref.ref(pos), pos._version, value)]
    return value


def _growth(cloth: Cloth, pos: Tensor) -> Tensor | None:
    """What the square of an edge at a vertex has grown by beyond :data:`COVERED`, at most, (V,) [m²]; None where none has, on
    a CPU (elsewhere the host would wait for the answer)."""
    growth = cloth.edge_sq(pos) - COVERED * cloth.rest_edge_sq
    traced = type(growth) is not Tensor  # has no values to ask for
    if growth.device.type == "cpu" and not traced and not growth.requires_grad and not bool((growth > 0.0).any()):
        return None
    return cloth.largest_of_edges(growth.clamp_min(0.0))


def vertex_reach(form: str, least: float, cloth: Cloth, contact: Contact, pos: Tensor) -> Tensor:
    """Distance from the skin [m] (V,) at which contact sets in: ``least`` [m], and by ``curvature`` the :func:`chord_error` as
    well, of cloth that is at ``pos`` (V, 3) [m] at t."""
    return least + (chord_error(cloth, contact, pos) if form == "curvature" else torch.zeros_like(contact.dist))
