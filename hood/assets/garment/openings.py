"""Openings of a garment, and whether a body is in them: what is worn has a limb, the neck or the trunk in every one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
