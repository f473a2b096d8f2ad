"""Repairs of triangle meshes, each a function that says what it did; positions are never moved.

Defects of a triangle mesh, counted, with first examples; nothing is changed or refused.

Faces without height: a corner lies on the opposite edge.

Vertices that stand out of a mesh like thorns, as a slip of the hand or a damaged file leaves them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from hood.mesh import topology
from hood.mesh.editing.quality import ZERO_AREA_RATIO
from hood.mesh.topology import unique_edges

#: Faces with a longest edge beyond this many times their height are slivers.
SLIVER_ASPECT = 50.0
#: Edges of three faces that are named.
_EXAMPLES = 3


@dataclass(frozen=True)
class Defects:
    """Counts; the legal ones (several components, openings, edges of three faces) are no faults by themselves."""

    num_components: int
    openings: tuple[int, ...]  # vertices of each boundary loop, longest first
    non_manifold_edges: int  # with three or more faces
    crowded_edges: tuple[tuple[int, int], ...]  # the first of them, by their vertices
    broken_faces: int  # a repeated vertex, or no area
    duplicate_faces: int
    isolated_vertices: int
    flipped_faces: int  # against their neighbours
    unwelded_vertices: int  # on a boundary, at the place of another
    slivers: int
    edge_length: tuple[float, float, float]  # least, median and greatest

    @property
    def none(self) -> bool:
        """Whether nothing needs repair."""
        return not (
            self.broken_faces or self.duplicate_faces or self.isolated_vertices or self.flipped_faces or self.unwelded_vertices
        )


def find_defects(pos: np.ndarray, faces: np.ndarray) -> Defects:
    """Defects of the mesh ``pos`` (V, 3), ``faces`` (F, 3) with indices in range and finite positions."""
    edges = topology.unique_edges(faces)
    length = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    alone = isolated_vertices(len(pos), faces)
    component = topology.connected_components(len(pos), edges)
    welded = weld(pos, faces, weld_tolerance(pos, faces))
    broken = broken_faces(pos, faces)
    sound, crowded = faces[~broken], _crowded_edges(faces)
    return Defects(
        num_components=len(np.unique(component[~alone])),
        openings=tuple(len(loop) for loop in topology.boundary_loops(faces)),
        non_manifold_edges=len(crowded),
        crowded_edges=tuple((int(a), int(b)) for a, b in crowded[:_EXAMPLES]),
        broken_faces=int(broken.sum()),
        duplicate_faces=int(duplicate_faces(faces).sum()),
        isolated_vertices=int(alone.sum()),
        flipped_faces=int(flipped_faces(sound).sum()),
        unwelded_vertices=len(pos) - len(welded.kept),
        slivers=int((aspects(pos, sound) > SLIVER_ASPECT).sum()),
        edge_length=(float(length.min()), float(np.median(length)), float(length.max())) if len(length) else (0.0, 0.0, 0.0),
    )


def _crowded_edges(faces: np.ndarray) -> np.ndarray:
    """(n, 2) edges of three faces and more."""
    edges, counts = topology.counted_edges(faces)
    return np.asarray(edges[counts > 2])


def aspects(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Longest edge over height (F,) of the faces (F, 3) of ``pos`` (V, 3); not finite where they have no area."""
    corners = pos[faces]
    longest_sq = ((corners - corners[:, [1, 2, 0]]) ** 2).sum(axis=2).max(axis=1, initial=0.0)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(0.5 * longest_sq / area)


#: Faces lower than this share of their longest edge are caps.
FLAT = 1e-3


def find_caps(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces (F, 3) of ``pos`` (V, 3) whose height is less than :data:`FLAT` of their longest edge, but not 0."""
    found = aspects(pos, faces)
    return np.asarray(np.isfinite(found) & (found * FLAT > 1.0))


def turn_caps(pos: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Every cap and the face behind its longest edge divided along the other diagonal; a cap without one left out.

    Returns:
        The corners of the new faces (F', 3, 2), each as (face, corner) of the old one that it is taken from; the old face
        (F',) that stands for each, the one that is no cap; and how many caps there were. Caps whose neighbour cannot be
        divided stay.
    """
    corners = np.stack([np.repeat(np.arange(len(faces))[:, None], 3, axis=1), np.tile(np.arange(3), (len(faces), 1))], axis=2)
    parent, kept, touched, count = np.arange(len(faces)), np.ones(len(faces), bool), np.zeros(len(faces), bool), 0
    caps = np.flatnonzero(find_caps(pos, faces))
    owners: dict[tuple[int, int], list[int]] = {}
    if len(caps):
        for face, row in enumerate(faces.tolist()):
            for i in range(3):
                owners.setdefault((row[i], row[(i + 1) % 3]), []).append(face)
    for cap in caps.tolist():
        sides = np.linalg.norm(pos[faces[cap]] - pos[np.roll(faces[cap], -1)], axis=1)
        i = int(sides.argmax())  # from a to b; n lies on it
        a, b = int(faces[cap, i]), int(faces[cap, (i + 1) % 3])
        behind, same = owners.get((b, a), []), owners.get((a, b), [])
        if touched[cap] or len(same) != 1 or len(behind) > 1 or any(touched[behind]):
            continue
        count += 1
        touched[cap] = True
        if not behind:
            kept[cap] = False
            continue
        (other,) = behind
        touched[other] = True
        j = int(np.flatnonzero(faces[other] == b)[0])
        n, at_b, at_a, d = (cap, (i + 2) % 3), (other, j), (other, (j + 1) % 3), (other, (j + 2) % 3)
        corners[cap], corners[other] = (n, at_a, d), (at_b, n, d)
        parent[cap] = other
    return corners[kept], parent[kept], count


#: ``weld`` of "auto": vertices nearer than this share of the median edge are one.
WELD_RATIO = 1e-3


class Welded(NamedTuple):
    """``vertex_map`` (V,) leads from the old to the new vertices, ``kept`` (V',) from the new to the old."""

    vertex_map: np.ndarray
    kept: np.ndarray


def boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Vertices (n,) of edges that belong to exactly one face, ascending."""
    edges, counts = topology.counted_edges(faces)
    return np.unique(edges[counts == 1])


def weld_tolerance(pos: np.ndarray, faces: np.ndarray) -> float:
    """Distance [m] within which two vertices of a boundary are taken for one: a thousandth of the median edge."""
    edges = topology.unique_edges(faces)
    length = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    positive = length[length > 0]
    return WELD_RATIO * float(np.median(positive)) if len(positive) else 0.0


def weld(pos: np.ndarray, faces: np.ndarray, tolerance: float, left_out: np.ndarray | None = None) -> Welded:
    """Vertices on the boundary within ``tolerance`` [m] of each other become the first of them, but for some ``left_out`` (N,).

    Only boundary vertices: layers that touch (a pocket on a shirt) stay apart. Vertices that share a face are joined only
    where they coincide, or a tolerance beyond the edge length would eat the mesh. Chains count: a–b and b–c join a, b and c.
    """
    candidates = boundary_vertices(faces)
    candidates = candidates if left_out is None else np.setdiff1d(candidates, left_out)
    pairs = cKDTree(pos[candidates]).query_pairs(tolerance, output_type="ndarray") if len(candidates) else np.zeros((0, 2), int)
    pairs = candidates[pairs]
    edges = topology.unique_edges(faces)
    key = int(len(pos))
    joined = np.isin(np.sort(pairs, axis=1) @ [key, 1], edges @ [key, 1])
    apart = np.linalg.norm(pos[pairs[:, 0]] - pos[pairs[:, 1]], axis=1) > 0
    return merge(len(pos), pairs[~(joined & apart)])


def merge(num_vertices: int, pairs: np.ndarray) -> Welded:
    """Vertices connected by ``pairs`` (n, 2) become the one of the lowest number; the order is kept."""
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(num_vertices, num_vertices))
    _, label = connected_components(graph, directed=False)
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    kept = np.sort(first)
    return Welded(np.searchsorted(kept, first)[inverse.reshape(-1)], kept)


def sew_moving(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces (F', 3) of a moving mesh (T, W, 3) with doubled boundary vertices joined: the first of those that lie on each
    other in every frame stands for all. Vertices and their numbers stay; faces that lose a corner are left out.
    """
    tolerance = weld_tolerance(verts[0], faces)
    welded = weld(verts[0], faces, tolerance)
    first = welded.kept[welded.vertex_map]
    doubled = np.flatnonzero(first != np.arange(len(first)))
    # Lips that are closed in the first frame may open later. A chain of near pairs is a few tolerances long.
    apart = np.zeros(len(doubled))
    for frame in verts:
        apart = np.maximum(apart, np.linalg.norm(frame[doubled] - frame[first[doubled]], axis=1))
    opened = doubled[apart > 10.0 * tolerance]
    first[opened] = opened
    joined = first[faces]
    ordered = np.sort(joined, axis=1)
    return np.asarray(joined[(ordered[:, 1:] != ordered[:, :-1]).all(axis=1)])


def broken_faces(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces that repeat a vertex or have no area."""
    a, b, c = (pos[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest_sq = np.max([((x - y) ** 2).sum(axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    return area <= ZERO_AREA_RATIO * longest_sq


def duplicate_faces(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces with the vertices of an earlier one, in any order."""
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    repeated = np.ones(len(faces), dtype=bool)
    repeated[first] = False
    return repeated


def isolated_vertices(num_vertices: int, faces: np.ndarray) -> np.ndarray:
    """(V,) bool: vertices of no face."""
    alone = np.ones(num_vertices, dtype=bool)
    alone[faces.reshape(-1)] = False
    return alone


def flipped_faces(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces to turn over so that neighbours over an edge of two faces agree; the smaller part of each component.

    Where a component cannot be oriented (a Möbius strip) the faces reached last keep a disagreement.
    """
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    owner = np.repeat(np.arange(len(faces)), 3)
    key = np.sort(half, axis=1) @ np.array([int(faces.max(initial=0)) + 1, 1])
    order = np.argsort(key, kind="stable")
    run_start = np.flatnonzero(np.r_[True, np.diff(key[order]) > 0])
    size = np.diff(np.r_[run_start, len(order)])
    first, second = order[run_start[size == 2]], order[run_start[size == 2] + 1]
    disagree = half[first, 0] == half[second, 0]
    return _two_colouring(len(faces), owner[first], owner[second], disagree)


def _two_colouring(count: int, a: np.ndarray, b: np.ndarray, differ: np.ndarray) -> np.ndarray:
    """(count,) bool with value(a) ^ value(b) = differ along breadth-first trees; the less frequent value is True."""
    value = np.where(differ, 2, 1)  # stored, not zero
    graph = coo_matrix((np.r_[value, value], (np.r_[a, b], np.r_[b, a])), shape=(count, count)).tocsr()
    number, label = connected_components(graph, directed=False)
    flipped = np.zeros(count, dtype=bool)
    if not differ.any():
        return flipped
    lookup = {(int(i), int(j)): bool(d) for i, j, d in zip(np.r_[a, b], np.r_[b, a], np.r_[differ, differ], strict=True)}
    _, first = np.unique(label, return_index=True)
    for component in np.unique(label[a[differ]]):
        nodes, parent = breadth_first_order(graph, int(first[component]), directed=False)
        for node in nodes[1:].tolist():
            flipped[node] = flipped[parent[node]] ^ lookup[(int(parent[node]), node)]
        members = label == component
        if flipped[members].sum() * 2 > members.sum():
            flipped[members] = ~flipped[members]
    assert number == len(first)
    return flipped


#: A thorn is at least so many times as long as the edges around it, and as the ring of its neighbours is wide. A mesh whose
#: edges become longer has 2 at most, the tip of a cap or a hood is as far from its ring as that is wide. The tip of a fan of
#: more triangles than these is a hat up to another multiple.
_LONGER, _FAN, _HAT = 3.5, 12, 5.0


class Spikes(NamedTuple):
    """Vertices that stand out."""

    vertices: np.ndarray  # (n,) ascending
    height: np.ndarray  # (n,) to the nearest neighbour, in the mesh's unit
    ratio: np.ndarray  # (n,) of that to the middle length of the edges around


def find_spikes(pos: np.ndarray, faces: np.ndarray, least: float) -> Spikes:
    """Vertices of the mesh ``pos`` (V, 3), ``faces`` (F, 3) at least ``least`` from all neighbours, in the mesh's unit, and far
    beside the edges of those."""
    edges = unique_edges(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    starts = np.searchsorted(both[:, 0], np.arange(len(pos) + 1))
    length = np.linalg.norm(pos[both[:, 1]] - pos[both[:, 0]], axis=1)
    nearest = np.full(len(pos), np.inf)
    np.minimum.at(nearest, both[:, 0], length)
    found = []
    for vertex in np.flatnonzero((nearest >= least) & (nearest < np.inf)):
        ring = both[starts[vertex] : starts[vertex + 1], 1]
        rows = np.concatenate([np.arange(starts[other], starts[other + 1]) for other in ring])
        around = np.median(length[rows[both[rows, 1] != vertex]])
        wide = np.linalg.norm(pos[ring] - pos[ring].mean(axis=0), axis=1).max()
        if nearest[vertex] >= max(_LONGER * around, (_HAT if len(ring) > _FAN else _LONGER) * wide):
            found.append((vertex, nearest[vertex] / around))
    vertices = np.array([vertex for vertex, _ in found], dtype=np.int64)
    return Spikes(vertices, nearest[vertices], np.array([ratio for _, ratio in found]))
