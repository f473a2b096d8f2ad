"""Parts of one object that were one garment: cut, and moved away from each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hood.assets.garment.contents.objects import OPENING
from hood.mesh.parts import Part, rim_length
from hood.mesh.seams import find_rims, ways_out

#: Lengths of two rims of one cut differ by at most this share.
_ALIKE = 0.15
#: This share of their vertices is at most so far [m] from the other rim.
_MOST, _FAR = 0.9, 0.05
#: Cosine between the way out of a part across its rim and the way to the other rim, in the mean: a lining beside its garment
#: has 0, a hem over a waistband less.
_AHEAD = 0.4


class Gap(NamedTuple):
    """Two rims that face each other all along."""

    parts: tuple[int, int]  # places in the list of parts
    middle: float  # m, median distance
    widest: float  # m


def find_gaps(pos: np.ndarray, faces: np.ndarray, parts: list[Part]) -> list[Gap]:
    """Gaps between ``parts`` of the mesh ``pos`` (V, 3) [m], ``faces`` (F, 3) that can be worn by themselves."""
    ways = ways_out(pos, find_rims(faces))
    rims = [
        (number, rim, length)
        for number, part in enumerate(parts)
        if part.can_be_put_on
        for rim in part.rims
        if (length := rim_length(pos, rim)) >= OPENING
    ]
    found = []
    for row, (one, rim, length) in enumerate(rims):
        for other, facing, its_length in rims[row + 1 :]:
            if one == other or min(length, its_length) < (1.0 - _ALIKE) * max(length, its_length):
                continue
            dist, there = cKDTree(pos[facing]).query(pos[rim])
            its_dist, here = cKDTree(pos[rim]).query(pos[facing])
            both = np.concatenate([dist, its_dist])
            ahead = _mean_cosine(ways[rim], pos[facing][there] - pos[rim])
            its_ahead = _mean_cosine(ways[facing], pos[rim][here] - pos[facing])
            if np.quantile(both, _MOST) <= _FAR and min(ahead, its_ahead) > _AHEAD:
                found.append(Gap((one, other), float(np.median(both)), float(both.max())))
    return found


def _mean_cosine(unit: np.ndarray, other: np.ndarray) -> float:
    """Between unit vectors (n, 3) and others, in the mean."""
    return float(((unit * other).sum(axis=1) / np.maximum(np.linalg.norm(other, axis=1), 1e-30)).mean())
