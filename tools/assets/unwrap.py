"""The panels of a garment, laid flat side by side: its seams and its texture coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import factorized

from hood.mesh import topology
from hood.mesh.editing.remeshing import Array, Faces, compact, remesh_normals
from tools.assets.remesh import diffuse

#: Length [m] over which the facing of the cloth is smoothed: a seam is a smooth line.
_SEAM_REACH = 0.05
_ROUNDS = 60
_MARGIN = 0.01  # between the panels, share of the unit square
#: Least cotangent weight: obtuse triangles must not push.
_LEAST_WEIGHT = 0.05


def panels(verts: Array, faces: Faces, parts: Sequence[Array] = ()) -> NDArray[np.int64]:
    """Panel (F,) of each face; even: front, odd: back, by which way the smoothed surface faces. Each panel is one piece.

    Args:
        parts: vertex values (V,), each negative on one part, a sleeve or a leg, that has panels of its own: a front with two
            legs would fold over itself at the crotch, laid flat.
    """
    facing = diffuse(remesh_normals(verts, faces)[:, 2:], verts, faces, _SEAM_REACH)[:, 0]
    panel = _halves(facing, faces)
    for k, part in enumerate(parts, start=1):
        panel += 2**k * _halves(part, faces)
    return panel


def _halves(value: Array, faces: Faces) -> NDArray[np.int64]:
    """(F,) 1 where the vertex values (V,) of a face are negative on average, else 0; two pieces along a smooth seam."""
    half = (value[faces].mean(axis=1) < 0).astype(np.int64)
    across = topology.hinges(faces).faces
    for _ in range(20):
        before = half.copy()
        half = _without_teeth(_without_islands(half, across), across)
        if np.array_equal(before, half):
            return half
    return _without_islands(half, across)


def _without_teeth(panel: NDArray[np.int64], across: Faces) -> NDArray[np.int64]:
    """Faces with two neighbours in the other panel join it: the seam gets shorter every time."""
    differ = panel[across[:, 0]] != panel[across[:, 1]]
    count = np.bincount(across[differ].ravel(), minlength=len(panel))
    total = np.bincount(across.ravel(), minlength=len(panel))
    flip = (count >= 2) & (count > total - count)
    # Of two neighbours that would trade places one stays.
    both = across[differ & flip[across[:, 0]] & flip[across[:, 1]]]
    flip[both[:, 1]] = False
    return np.where(flip, 1 - panel, panel)


def _without_islands(panel: NDArray[np.int64], across: Faces) -> NDArray[np.int64]:
    panel = panel.copy()
    for side in (0, 1):
        inner = across[(panel[across] == side).all(axis=1)]
        label = topology.connected_components(len(panel), inner)
        count = np.bincount(label[panel == side])
        panel[(panel == side) & (label != count.argmax())] = 1 - side
    return panel


def unwrap(verts: Array, faces: Faces, panel: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Texture coordinates (U,2) in 0..1 and their triangles (F,3): the panels flat at one scale, in a row."""
    flat, uv_faces, offset, start = [], np.zeros_like(faces), 0.0, 0
    for side in np.unique(panel):
        rows = np.flatnonzero(panel == side)
        points, triangles = compact(verts, faces[rows])
        plane = flatten(points, triangles) * ([1.0, 1.0] if side % 2 == 0 else [-1.0, 1.0])
        flat.append(plane - plane.min(axis=0) + [offset, 0.0])
        uv_faces[rows] = triangles + start
        start += len(points)
        offset = float(flat[-1][:, 0].max())
    # A strip between the panels, in the units of the plane.
    size = max(offset, max(float(part[:, 1].max()) for part in flat)) / (1.0 - _MARGIN)
    for k, part in enumerate(flat):
        part[:, 0] += k * _MARGIN * size
    return (np.concatenate(flat) / (size * (1 + _MARGIN * (len(flat) - 1)))).astype(np.float32), uv_faces


def flatten(verts: Array, faces: Faces) -> Array:
    """A panel (V,3) in the plane (V,2) [m] with its lengths kept as well as they can be, from its front view on.

    As rigid as possible (Liu et al. 2008): triangles turn, then vertices follow them, in turns.
    """
    local = _in_their_planes(verts, faces)
    weight = np.maximum(_cotangents(local), _LEAST_WEIGHT)  # (F,3), of the edge opposite to corner k
    plane = verts[:, :2].copy()
    if (remesh_normals(verts, faces)[:, 2]).mean() < 0:
        plane[:, 0] *= -1.0
    first, second = np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)
    rows, columns, values = first.ravel(), second.ravel(), weight.ravel()
    matrix = sparse.coo_matrix((values, (rows, columns)), shape=(len(verts),) * 2).tocsr()
    matrix = matrix + matrix.T
    laplace = sparse.diags(np.asarray(matrix.sum(axis=1)).ravel()) - matrix + 1e-9 * sparse.identity(len(verts))
    solve = factorized(laplace.tocsc())
    edge = np.roll(local, -1, axis=1) - np.roll(local, -2, axis=1)  # (F,3,2)
    for _ in range(_ROUNDS):
        now = plane[first] - plane[second]
        turn = _rotations(np.einsum("fk,fki,fkj->fij", weight, now, edge))
        pull = weight[..., None] * np.einsum("fij,fkj->fki", turn, edge)
        right = np.zeros_like(plane)
        np.add.at(right, first.ravel(), pull.reshape(-1, 2))
        np.subtract.at(right, second.ravel(), pull.reshape(-1, 2))
        plane = np.stack([solve(column) for column in right.T], axis=1)
    return plane if (remesh_normals(verts, faces)[:, 2]).mean() >= 0 else plane * [-1.0, 1.0]


def _in_their_planes(verts: Array, faces: Faces) -> Array:
    """Corners (F,3,2) [m] of each face in its own plane, anticlockwise."""
    a, b, c = (verts[faces[:, k]] for k in range(3))
    length = np.linalg.norm(b - a, axis=1)
    along = (b - a) / length[:, None]
    x = ((c - a) * along).sum(axis=1)
    y = np.linalg.norm(c - a - x[:, None] * along, axis=1)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, zero], 1), np.stack([length, zero], 1), np.stack([x, y], 1)], axis=1)


def _cotangents(local: Array) -> Array:
    """(F,3) half cotangents of the angles at the corners."""
    one, two = np.roll(local, -1, axis=1) - local, np.roll(local, -2, axis=1) - local
    cross = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
    return 0.5 * (one * two).sum(axis=2) / cross


def _rotations(matrix: Array) -> Array:
    """Rotations (F,2,2) nearest to matrices (F,2,2)."""
    cos, sin = matrix[:, 0, 0] + matrix[:, 1, 1], matrix[:, 1, 0] - matrix[:, 0, 1]
    length = np.maximum(np.hypot(cos, sin), 1e-300)
    cos, sin = cos / length, sin / length
    return np.stack([np.stack([cos, -sin], 1), np.stack([sin, cos], 1)], axis=1)
