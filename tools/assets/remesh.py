"""Cuts, remeshes and smooths open triangle surfaces for the tailor; imports of the build-time packages."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import factorized

from hood.assets.files.said import install
from hood.mesh import topology
from hood.mesh.editing.remeshing import Array, Faces, closest, compact, laplacian, neighbours, remesh_normals

_LEAST_LOOP = 12


def require(name: str) -> ModuleType:
    """Import a build-time package.

    Raises:
        ImportError: the package is missing; the message says how to get all of them.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"building the default assets needs {name!r}: {install('assets')}") from error


def cut(verts: Array, faces: Faces, keep: Array) -> tuple[Array, Faces]:
    """The part of a surface where the vertex function `keep` (V,) is positive, cut along its zero line.

    Crossed triangles are split at the linear zero of their edges, so the hem is as smooth as the function.
    """
    # An exact zero would create edges of length zero.
    keep = np.where(np.abs(keep) < 1e-9, 1e-9, keep)
    inside = keep[faces] > 0
    count = inside.sum(1)
    crossed = topology.unique_edges(faces)
    crossed = crossed[(keep[crossed[:, 0]] > 0) != (keep[crossed[:, 1]] > 0)]
    share = keep[crossed[:, 0]] / (keep[crossed[:, 0]] - keep[crossed[:, 1]])
    middle = verts[crossed[:, 0]] + share[:, None] * (verts[crossed[:, 1]] - verts[crossed[:, 0]])
    index = {(int(a), int(b)): len(verts) + i for i, (a, b) in enumerate(crossed)}

    def split(a: int, b: int) -> int:
        return index[(min(a, b), max(a, b))]

    kept = [tuple(face) for face in faces[count == 3].tolist()]
    for face, flags in zip(faces.tolist(), inside.tolist(), strict=True):
        if sum(flags) in (0, 3):
            continue
        start = flags.index(sum(flags) == 1)  # the corner that is alone on its side
        a, b, c = face[start], face[(start + 1) % 3], face[(start + 2) % 3]
        ab, ca = split(a, b), split(c, a)
        kept += [(a, ab, ca)] if sum(flags) == 1 else [(ab, b, c), (ab, c, ca)]
    return compact(np.concatenate([verts, middle]), np.array(kept, dtype=np.int64))


def largest_component(verts: Array, faces: Faces) -> tuple[Array, Faces]:
    """The connected component with most vertices."""
    label = topology.connected_components(len(verts), topology.unique_edges(faces))
    wanted = np.bincount(label).argmax()
    return compact(verts, faces[label[faces[:, 0]] == wanted])


def collapse_short(verts: Array, faces: Faces, ratio: float) -> tuple[Array, Faces]:
    """Contracts edges shorter than `ratio` times the mean where the surface stays a manifold."""
    edges = topology.unique_edges(faces)
    limit = ratio * np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1).mean()
    refused: set[tuple[int, int]] = set()
    while True:
        edges = topology.unique_edges(faces)
        length = np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)
        short = [(int(a), int(b)) for a, b in edges[np.argsort(length)] if (int(a), int(b)) not in refused]
        if not short or np.linalg.norm(verts[short[0][0]] - verts[short[0][1]]) > limit:
            return compact(verts, faces)
        first, second = short[0]
        border = np.zeros(len(verts), dtype=bool)
        for loop in topology.boundary_loops(faces):
            border[loop] = True
        shared = np.intersect1d(neighbours(faces, first), neighbours(faces, second))
        opposite = ((faces == first).any(1) & (faces == second).any(1)).sum()
        # The link condition; an inner edge between two boundary vertices would pinch the surface.
        if len(shared) != opposite or (border[first] and border[second] and opposite == 2):
            refused.add((first, second))
            continue
        verts = verts.copy()
        if border[first] == border[second]:
            verts[first] = (verts[first] + verts[second]) / 2
        elif border[second]:
            verts[first] = verts[second]
        faces = np.where(faces == second, first, faces)
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]


def diffuse(values: Array, verts: Array, faces: Faces, reach: float) -> Array:
    """Vertex values (V,C) smoothed over about `reach` [m]: one implicit step of the heat equation."""
    edges = topology.unique_edges(faces)
    mean_edge = np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1).mean()
    # On a triangle grid of edge h the operator x - mean is -h²/4 times the Laplacian.
    solve = factorized((sparse.identity(len(verts)) + 4 * (reach / mean_edge) ** 2 * laplacian(faces, len(verts))).tocsc())
    return np.stack([solve(column) for column in values.T], axis=1)


def smooth_loops(verts: Array, faces: Faces, iterations: int) -> Array:
    """Boundary loops smoothed as curves (Taubin's two steps, which keep the length of loops of many vertices).

    Loops of fewer than ``_LEAST_LOOP`` vertices stay: each round would shorten a cuff of six by a twentieth.
    """
    verts = verts.copy()
    for loop in topology.boundary_loops(faces):
        if len(loop) < _LEAST_LOOP:
            continue
        curve = verts[loop]
        for _ in range(iterations):
            for factor in (0.5, -0.53):
                curve = curve + factor * ((np.roll(curve, 1, 0) + np.roll(curve, -1, 0)) / 2 - curve)
        verts[loop] = curve
    return verts


def push_out(
    verts: Array,
    faces: Faces,
    body_verts: Array,
    body_faces: Faces,
    margin: float,
    rounds: int = 12,
    near: float | None = None,
) -> Array:
    """Moves vertices and face centres nearer than `near` [m] (default: `margin`) to `margin` [m] outside the body; neighbours
    follow."""
    near = margin if near is None else near

    def lacking(points: Array) -> Array:
        dist = closest(points, body_verts, body_faces).dist.numpy()
        return np.where(dist < near, margin - dist, 0.0)

    for _ in range(rounds):
        push, middle = lacking(verts), lacking(verts[faces].mean(1))
        for k in range(3):
            np.maximum.at(push, faces[:, k], middle)
        if push.max() <= 0:
            break
        spread = push - 0.5 * (laplacian(faces, len(verts)) @ push)
        verts = verts + np.maximum(push, spread)[:, None] * remesh_normals(verts, faces)
    return verts
