"""Parts of one object that were one garment: cut, and moved away from each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hood.assets.garment.contents.objects import OPENING
from hood.mesh.parts import Part, rim_length
from hood.mesh.topology import unique_edges

#: Lengths of two rims of one cut differ by at most this share.
_ALIKE = 0.15
#: This share of their vertices is at most so far [m] from the other rim.
_MOST, _FAR = 0.9, 0.05
#: Cosine between the way out of a part across its rim and the way to the other rim, in the mean: a lining beside its garment
#: has 0, a hem over a waistband less.
AHEAD = 0.4


class Gap(NamedTuple):
    """Two rims that face each other all along."""

    parts: tuple[int, int]  # places in the list of parts
    middle: float  # m, median distance
    widest: float  # m


def find_gaps(pos: np.ndarray, faces: np.ndarray, parts: list[Part]) -> list[Gap]:
    """Gaps between ``parts`` of the mesh ``pos`` (V, 3) [m], ``faces`` (F, 3) that can be worn by themselves."""
    rims = [
        (number, rim, rim_length(pos, rim), ahead_of(pos, faces[part.faces], rim))
        for number, part in enumerate(parts)
        if part.can_be_put_on
        for rim in part.rims
        if rim_length(pos, rim) >= OPENING
    ]
    found = []
    for row, (one, rim, length, ahead) in enumerate(rims):
        for other, facing, its_length, its_ahead in rims[row + 1 :]:
            if one == other or min(length, its_length) < (1.0 - _ALIKE) * max(length, its_length):
                continue
            dist, there = cKDTree(pos[facing]).query(pos[rim])
            its_dist, here = cKDTree(pos[rim]).query(pos[facing])
            way, its_way = pos[facing][there] - pos[rim], pos[rim][here] - pos[facing]
            both = np.concatenate([dist, its_dist])
            if np.quantile(both, _MOST) <= _FAR and min(mean_cosine(ahead, way), mean_cosine(its_ahead, its_way)) > AHEAD:
                found.append(Gap((one, other), float(np.median(both)), float(both.max())))
    return found


def ahead_of(pos: np.ndarray, faces: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """(n, 3) m: the way out of a part across its rim, to each vertex from the middle of its neighbours that are not on the rim;
    zero where it has none."""
    edges = unique_edges(faces)
    edges = np.concatenate([edges, edges[:, ::-1]])
    edges = edges[np.isin(edges[:, 0], rim) & ~np.isin(edges[:, 1], rim)]
    count = np.bincount(edges[:, 0], minlength=len(pos))[rim]
    total = np.stack([np.bincount(edges[:, 0], pos[edges[:, 1], axis], len(pos))[rim] for axis in range(3)], axis=1)
    return np.where((count > 0)[:, None], pos[rim] - total / np.maximum(count, 1)[:, None], 0.0)


def mean_cosine(one: np.ndarray, other: np.ndarray) -> float:
    """In the mean over vectors (n, 3)."""
    scale = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    return float(((one * other).sum(axis=1) / np.maximum(scale, 1e-30)).mean())
