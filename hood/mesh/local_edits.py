"""Local edits of open triangle surfaces: edges flipped, vertices relaxed, unused vertices dropped."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse

from hood.mesh import topology
from hood.mesh.proximity import SurfaceHit, search_surface

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


def compact(verts: Array, faces: Faces) -> tuple[Array, Faces]:
    """The surface without unused vertices."""
    used, inverse = np.unique(faces, return_inverse=True)
    return verts[used], inverse.reshape(faces.shape).astype(np.int64)


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


def neighbours(faces: Faces, vertex: int) -> Faces:
    """Vertices that share a face with ``vertex``, ascending."""
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
