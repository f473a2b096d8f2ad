"""Garments that open in front: one half and its mirror image, joined at the back, with a slit of paired vertices in front."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hood.mesh import topology
from hood.mesh.editing.remeshing import Array, Faces, compact, isotropic
from tools.assets.remesh import cut, largest_component

#: Width [m] of the slit: layers of cloth are kept 3 mm apart (hood/energies/self_contact.py), and what is fastened is at rest.
WIDTH = 0.004
#: The half is cut off so far [m] from the middle, then drawn there: cuts through vertices would make edges without length.
_OFF = 0.0005
#: Between the front and the back [m]; and how near [m] to the middle the vertices at the slit are.
_MIDDLE_Z, _NEAR = 0.035, 0.012


def open_front(verts: Array, faces: Faces, num_vertices: int, tolerance: float) -> tuple[Array, Faces]:
    """A garment that is symmetric in x and closed, remeshed to ``num_vertices``, with a slit of :data:`WIDTH` along its front.

    Raises:
        ValueError: the right half has no edge from neck to hem in front or at the back.
    """
    half, half_faces = largest_component(*cut(verts, faces, verts[:, 0] - _OFF))
    corners = _corners(half, half_faces)
    verts, faces = isotropic(half, half_faces, num_vertices // 2, tolerance)
    loop = max(topology.boundary_loops(faces), key=len)
    ends = [int(np.argmin(np.linalg.norm(verts[loop] - corner, axis=1))) for corner in corners]
    verts[loop[ends]] = corners
    front, back = _arc(verts, loop, *ends[:2]), _arc(verts, loop, *ends[2:])
    verts[front, 0], verts[back, 0] = WIDTH / 2, 0.0
    number = np.arange(len(verts)) + len(verts)
    number[back] = back
    return compact(np.concatenate([verts, verts * [-1.0, 1.0, 1.0]]), np.concatenate([faces, number[faces][:, ::-1]]))


def _corners(verts: Array, faces: Faces) -> Array:
    """(4, 3) ends of the edges in the middle of the half: front top, front bottom, back top, back bottom."""
    loop = max(topology.boundary_loops(faces), key=lambda one: int((verts[one, 0] < 1.5 * _OFF).sum()))
    found = []
    for before in (True, False):
        members = loop[(verts[loop, 0] < 1.5 * _OFF) & ((verts[loop, 2] > _MIDDLE_Z) == before)]
        if len(members) == 0:
            raise ValueError("front: the half has no edge in the middle; cut a garment that reaches around the body")
        found += [verts[members[np.argmax(verts[members, 1])]], verts[members[np.argmin(verts[members, 1])]]]
    return np.array(found)


def _arc(verts: Array, loop: NDArray[np.int64], top: int, bottom: int) -> NDArray[np.int64]:
    """The part of a loop between two of its places that lies nearer to the middle."""
    count = len(loop)
    ahead = loop[np.arange(top, top + (bottom - top) % count + 1) % count]
    behind = loop[np.arange(top, top - (top - bottom) % count - 1, -1) % count]
    return min((ahead, behind), key=lambda arc: float(np.abs(verts[arc, 0]).mean()))


def slit_pairs(verts: Array, faces: Faces) -> NDArray[np.int64]:
    """Vertices (P, 2) of the slit opposite of each other, right and left, from the top down.

    Raises:
        ValueError: the two edges have different numbers of vertices.
    """
    border = np.concatenate(topology.boundary_loops(faces))
    near = border[(np.abs(verts[border, 0]) < _NEAR) & (verts[border, 2] > _MIDDLE_Z)]
    sides = [near[sign * verts[near, 0] < 0] for sign in (1, -1)]
    if len(sides[0]) != len(sides[1]):
        raise ValueError(f"front: {len(sides[0])} vertices right of the slit and {len(sides[1])} left of it; remesh it")
    return np.stack([side[np.argsort(-verts[side, 1])] for side in sides], axis=1)


def pull_apart(verts: Array, pairs: NDArray[np.int64]) -> Array:
    """The vertices (V, 3) with those of every pair at one height and depth, :data:`WIDTH` apart in x."""
    verts = verts.copy()
    middle = verts[pairs].mean(axis=1)
    verts[pairs] = np.stack([middle - [WIDTH / 2, 0.0, 0.0], middle + [WIDTH / 2, 0.0, 0.0]], axis=1)
    return verts


def sewn_together(faces: Faces, pairs: NDArray[np.int64]) -> Faces:
    """``faces`` (F, 3) as if the two vertices of every pair were one: its openings are those of the closed garment."""
    number = np.arange(faces.max() + 1)
    number[pairs[:, 1]] = pairs[:, 0]
    return number[faces]
