"""Isotropic remeshing of open triangle surfaces (Botsch and Kobbelt 2004): split, collapse, flip, relax, project.

Splits and collapses are done in rounds of pairs that do not touch each other, chosen by length and then by number, so the
result depends on nothing but the input. Build time only.

Local edits of open triangle surfaces: edges flipped, vertices relaxed, unused vertices dropped.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from hood.mesh import topology
from hood.mesh.closest_point.search import SurfaceHit, search_surface

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


def remesh_normals(verts: Array, faces: Faces) -> Array:
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
        normal = remesh_normals(verts, faces)
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
    """Closest points of one surface (`hood.mesh.closest_point.search.search_surface`), chunked to bound the memory."""
    chunks = []
    surface = torch.as_tensor(verts, dtype=torch.float64), torch.as_tensor(np.asarray(faces, dtype=np.int64))
    owner = [torch.zeros(len(x), dtype=torch.int64) for x in surface]
    for start in range(0, len(points), 100_000):
        part = torch.as_tensor(np.ascontiguousarray(points[start : start + 100_000]), dtype=torch.float64)
        zeros = torch.zeros(len(part), dtype=torch.int64)
        chunks.append(search_surface(part, zeros, *surface, *owner))
    return SurfaceHit(*(torch.cat(column) for column in zip(*chunks, strict=True)))


_LONG, _SHORT = 4 / 3, 4 / 5
_ITERATIONS = 7
_MOST_ROUNDS = 60
#: Spacing [m] of the points that hems are kept on.
_HEM_STEP = 2e-4


def isotropic(verts: Array, faces: Faces, num_vertices: int, tolerance: float = 0.03) -> tuple[Array, Faces]:
    """The surface with ``num_vertices``, off by a share of ``tolerance``, and edges of one length; hems keep their curves."""
    corner = verts[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    edge = float(np.sqrt(area / num_vertices * 2 / np.sqrt(3)))
    for _ in range(6):
        new_verts, new_faces = _remeshed(verts, faces, edge)
        ratio = len(new_verts) / num_vertices
        if abs(ratio - 1) < tolerance:
            break
        edge *= float(np.sqrt(ratio))
    return new_verts, new_faces


def _remeshed(verts: Array, faces: Faces, edge: float) -> tuple[Array, Faces]:
    surface = verts, faces
    hems = cKDTree(_hem_points(verts, faces))
    for _ in range(_ITERATIONS):
        verts, faces = split_long(verts, faces, _LONG * edge)
        verts, faces = collapse_shorter(verts, faces, _SHORT * edge, _LONG * edge)
        faces = flip_edges(verts, faces)
        verts = relax(verts, faces, 5)
        verts = _project(verts, faces, surface, hems)
    return compact(verts, faces)


def _hem_points(verts: Array, faces: Faces) -> Array:
    points = [np.zeros((0, 3))]
    for loop in topology.boundary_loops(faces):
        curve = verts[np.append(loop, loop[0])]
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
        at = np.arange(0.0, along[-1], _HEM_STEP)
        points.append(np.stack([np.interp(at, along, column) for column in curve.T], axis=1))
    return np.concatenate(points)


def _project(verts: Array, faces: Faces, surface: tuple[Array, Faces], hems: cKDTree) -> Array:
    """Inner vertices on the closest point of ``surface``, boundary vertices on the closest of its hems."""
    border = np.zeros(len(verts), dtype=bool)
    for loop in topology.boundary_loops(faces):
        border[loop] = True
    hit = closest(verts[~border], *surface)
    projected = verts.copy()
    corners = surface[0][surface[1][hit.face.numpy()]]
    projected[~border] = np.einsum("vk,vkd->vd", hit.bary.numpy(), corners)
    projected[border] = hems.data[hems.query(verts[border])[1]]
    return projected


def split_long(verts: Array, faces: Faces, limit: float) -> tuple[Array, Faces]:
    """The surface with edges longer than ``limit`` halved, a face at most once a round, until none is left."""
    for _ in range(_MOST_ROUNDS):
        edges, of_face = _edges_of_faces(faces)
        length = np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)
        rank = _ranks(-length)
        # An edge is split where it is the longest of every face it bounds.
        best = rank[of_face].min(axis=1)
        chosen = length > limit
        for k in range(3):
            chosen[of_face[rank[of_face[:, k]] != best, k]] = False
        if not chosen.any():
            break
        new = np.full(len(edges), -1, dtype=np.int64)
        new[chosen] = len(verts) + np.arange(int(chosen.sum()))
        verts = np.concatenate([verts, verts[edges[chosen]].mean(axis=1)])
        parts = [faces[(new[of_face] < 0).all(axis=1)]]
        for k in range(3):
            rows = new[of_face[:, k]] >= 0
            a, b, c = faces[rows, k], faces[rows, (k + 1) % 3], faces[rows, (k + 2) % 3]
            middle = new[of_face[rows, k]]
            parts += [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        faces = np.concatenate(parts)
    return verts, faces


def collapse_shorter(verts: Array, faces: Faces, limit: float, longest: float) -> tuple[Array, Faces]:
    """The surface with edges shorter than ``limit`` contracted where it stays a manifold and no edge outgrows ``longest``."""
    for _ in range(_MOST_ROUNDS):
        edges, of_face = _edges_of_faces(faces)
        length = np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)
        num_faces = np.bincount(of_face.ravel(), minlength=len(edges))
        border = np.zeros(len(verts), dtype=bool)
        border[edges[num_faces == 1]] = True
        both = border[edges].all(axis=1)
        candidate = np.flatnonzero((length < limit) & ~(both & (num_faces == 2)))
        around = _Neighbours(edges, len(verts))
        taken = np.zeros(len(verts), dtype=bool)
        verts, target = verts.copy(), np.arange(len(verts))
        changed = False
        for row in candidate[np.argsort(length[candidate], kind="stable")].tolist():
            keep, gone = (int(v) for v in edges[row])
            if taken[keep] or taken[gone]:
                continue
            ring = around.of(keep) | around.of(gone)
            # The link condition: what both have as neighbour is across a face of their edge.
            if taken[list(ring)].any() or len(around.of(keep) & around.of(gone)) != num_faces[row]:
                continue
            if border[gone] and not border[keep]:
                keep, gone = gone, keep
            place = verts[keep] if border[keep] and not border[gone] else (verts[keep] + verts[gone]) / 2
            rest = np.fromiter(ring - {keep, gone}, dtype=np.int64)
            if (np.linalg.norm(verts[rest] - place, axis=1) > longest).any():
                continue
            taken[list(ring)] = True
            verts[keep], target[gone], changed = place, keep, True
        if not changed:
            break
        faces = target[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        verts, faces = compact(verts, faces)
    return verts, faces


def _edges_of_faces(faces: Faces) -> tuple[Faces, Faces]:
    """Unique edges (E,2), and for each face the three (F,3) that leave its corners."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    # One number per pair sorts many times faster than rows.
    count = int(faces.max()) + 1
    keys, inverse = np.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
    return np.stack(np.divmod(keys, count), axis=1), inverse.reshape(faces.shape)


def _ranks(values: Array) -> Faces:
    rank = np.empty(len(values), dtype=np.int64)
    rank[np.argsort(values, kind="stable")] = np.arange(len(values))
    return rank


class _Neighbours:
    """The vertices joined to a vertex by ``edges`` (E,2)."""

    def __init__(self, edges: Faces, num_vertices: int) -> None:
        both = np.concatenate([edges, edges[:, ::-1]])
        both = both[np.argsort(both[:, 0], kind="stable")]
        self._start = np.searchsorted(both[:, 0], np.arange(num_vertices + 1))
        self._end = both[:, 1]

    def of(self, vertex: int) -> set[int]:
        return set(self._end[self._start[vertex] : self._start[vertex + 1]].tolist())
