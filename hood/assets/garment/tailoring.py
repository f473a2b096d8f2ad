"""Parts of a garment cut larger or smaller than the rest of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.parts import part_faces

#: Weights of edges are cotangents, but for those of flat angles, which are at least this.
_LEAST = 1e-3
#: Pull of every vertex towards its place, as a share of the mean weight: it holds pieces of cloth where they are, no more.
_HOLD = 1e-8


def tailored(garment: Garment, factors: Mapping[str, float], body: Body | None = None) -> Garment:
    """The garment with a rest shape whose parts are larger or smaller; worn where it was.

    Where two parts meet, no cloth has the lengths of both. The new rest shape is the one whose edges are nearest to what
    their faces ask for, in the least squares of gradients that cotangent weights make independent of the mesh, so the step from
    one factor to the next is spread over some edges on both sides.

    Args:
        factors: of lengths, by part (:func:`hood.assets.garment.parts.part_faces`); of parts that overlap the last counts.
        body: whose joints names of parts mean, in T-pose; None refuses these.

    Raises:
        ValueError: a part that the garment does not have.
    """
    factor = np.ones(len(garment.faces))
    for part, value in factors.items():
        factor[part_faces(part, garment, body)] = value
    rest_pos, riders = _stretched(garment.rest_pos, garment.faces, factor), garment.riders
    if riders is not None:
        riders = replace(riders, pos=riders.positions(rest_pos, garment.rest_pos))
    return replace(garment, rest_pos=rest_pos, skin_pos=garment.worn_pos, riders=riders)


def lengths_of(before: Garment, after: Garment, part: str, body: Body | None = None) -> float:
    """How many times as long the edges of a part are in ``after``, all together."""
    faces = before.faces[part_faces(part, before, body)]
    return float(_edges(after.rest_pos, faces).sum() / _edges(before.rest_pos, faces).sum())


def _stretched(pos: np.ndarray, faces: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """(V, 3) m: ``pos`` (V, 3) with the edges of every face ``factor`` (F,) times as long, as nearly as a mesh can be."""
    count = len(pos)
    rows, values, target = [], [], np.zeros_like(pos)
    for corner in range(3):
        apex, i, j = (faces[:, (corner + step) % 3] for step in range(3))
        a, b = pos[i] - pos[apex], pos[j] - pos[apex]
        area = np.linalg.norm(np.cross(a, b), axis=1)
        weight = np.maximum((a * b).sum(axis=1) / np.maximum(area, 1e-30), _LEAST)
        asked = (weight * factor)[:, None] * (pos[i] - pos[j])
        np.add.at(target, i, asked)
        np.add.at(target, j, -asked)
        rows.append(np.stack([i, j], axis=1))
        values.append(weight)
    ends, weight = np.concatenate(rows), np.concatenate(values)
    off = sparse.coo_matrix((weight, (ends[:, 0], ends[:, 1])), shape=(count, count))
    degree = np.bincount(ends.ravel(), np.repeat(weight, 2), minlength=count)
    hold = _HOLD * degree[degree > 0].mean()
    matrix = sparse.diags(degree + hold) - off - off.T
    return np.asarray(splu(matrix.tocsc()).solve(target + hold * pos))


def _edges(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(pos[faces] - pos[np.roll(faces, 1, axis=1)], axis=2))
