"""Whether a garment lies around a body where its file has it, so that nothing asks for another place; and the way there.

Openings of a garment, and whether a body is in them: what is worn has a limb, the neck or the trunk in every one.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from hood.assets.fitting.placement import surrounds
from hood.assets.garment.binding import signed_distances
from hood.mesh import topology
from hood.mesh.parts import rim_length

#: Shorter openings are buttonholes and slits [body heights]: a child's cuff has 0.1.
_LEAST_LENGTH = 0.07
#: Where an opening's span is looked at, from its middle to its rim; a tight cuff lies on the skin itself.
_SHARES = np.array([0.0, 0.25, 0.45, 0.6, 0.7, 0.8, 0.9, 0.97])


class Openings(NamedTuple):
    """Openings of the parts that have at least two: a sheet has its rim alone, and nobody is in it."""

    num: int
    num_empty: int  # those with no part of the body in them


def find_openings(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, body_faces: np.ndarray) -> Openings:
    """How many openings of the garment ``pos`` (V, 3) [m], ``faces`` (F, 3) hold no part of a body ``surface`` (W, 3) [m].

    An opening is spanned by segments from its middle to its rim; it holds the body if one of them enters it.
    """
    least = _LEAST_LENGTH * float(np.ptp(surface, axis=0).max())
    loops = [loop for loop in topology.boundary_loops(faces) if rim_length(pos, loop) >= least]
    part = topology.connected_components(len(pos), topology.unique_edges(faces))
    count = np.bincount([part[loop[0]] for loop in loops], minlength=1) if loops else np.zeros(1, dtype=np.int64)
    loops = [loop for loop in loops if count[part[loop[0]]] > 1]
    return Openings(len(loops), _num_empty([pos[loop] for loop in loops], surface, body_faces))


def _num_empty(rims: list[np.ndarray], surface: np.ndarray, faces: np.ndarray) -> int:
    if not rims:
        return 0
    spans = [rim.mean(axis=0) + _SHARES[:, None, None] * (rim - rim.mean(axis=0)) for rim in rims]
    inside = signed_distances(np.concatenate([span.reshape(-1, 3) for span in spans]), surface, faces) < 0
    starts = np.cumsum([0, *(len(_SHARES) * len(rim) for rim in rims[:-1])])
    return int((~np.logical_or.reduceat(inside, starts)).sum())


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
