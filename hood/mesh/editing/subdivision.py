"""Every triangle into four, by a smooth surface through the vertices: these stay where they are, new ones lie between them.

A sheet of triangles with its thickness: a closed shell of two layers, and a strip along open edges between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from hood.mesh.topology import connected_components, edge_index, unique_edges

#: A rim that turns by more than this [rad] at a vertex has a corner there, which stays sharp.
_CORNER = np.radians(50.0)


class Subdivision:
    """A triangle mesh with every face cut into four, ``levels`` times. The vertices of the mesh come first, unmoved.

    A new vertex lies at the middle of an edge ab, on the cubic that is tangent to the surface at both ends (PN triangles,
    Vlachos and others 2001): (a + b)/2 − (((b − a)·n_a) n_a + ((a − b)·n_b) n_b)/8, with unit normals n of the vertices, whose
    faces count by their angles. Along rims, and seams of three faces, it lies on a curve through the vertices of the rim alone,
    (9 (a + b) − before − after)/16 (four-point scheme, Dyn and others 1987), so that a rim depends on nothing beside it. At a
    corner, and where a rim ends, the curve ends straight.

    What is flat stays flat, a straight rim straight; turning and moving the mesh turns and moves the finer one. No wrinkle is
    added to those that the mesh has.

    Args:
        faces: (F, 3).
        rest_pos: (V, 3) m, says where rims have corners.
        levels: how often.
    """

    def __init__(self, faces: np.ndarray, rest_pos: np.ndarray, levels: int) -> None:
        self.num_coarse = len(rest_pos)
        self._levels: list[_Level] = []
        self.faces, rest = np.asarray(faces, dtype=np.int64), np.asarray(rest_pos, dtype=np.float64)
        for _ in range(levels):
            level = _level(self.faces, rest)
            self._levels.append(level)
            self.faces, rest = level.finer, level.positions(rest)
        self.rest_pos: np.ndarray = rest  # (V′, 3) m

    @property
    def num_vertices(self) -> int:
        return len(self.rest_pos)

    def positions(self, pos: np.ndarray) -> np.ndarray:
        """(V′, 3) m, float64, of the finer mesh whose first vertices are at ``pos`` (V, 3)."""
        finer = np.asarray(pos, dtype=np.float64)
        for level in self._levels:
            finer = level.positions(finer)
        return finer

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Values of vertices (V, …), those of new vertices the means of the ends of their edges."""
        for level in self._levels:
            values = np.concatenate([values, values[level.edges].mean(axis=1, dtype=values.dtype)])
        return values

    def marks(self, values: np.ndarray) -> np.ndarray:
        """Marks of vertices (V, …), those of new vertices that of the one end of their edge with the smaller index."""
        for level in self._levels:
            values = np.concatenate([values, values[level.edges[:, 0]]])
        return values

    def texture(self, uv: np.ndarray, uv_faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Texture coordinates (U, 2) and their faces (F, 3) for the finer faces: every piece of texture keeps its edges."""
        for _ in self._levels:
            edges = unique_edges(uv_faces)
            uv_faces = quartered(uv_faces, edges, len(uv))
            uv = np.concatenate([uv, uv[edges].mean(axis=1, dtype=uv.dtype)])
        return uv, uv_faces


@dataclass(frozen=True)
class _Level:
    """One step of subdivision."""

    faces: np.ndarray  # (F, 3)
    edges: np.ndarray  # (E, 2), one new vertex each
    finer: np.ndarray  # (4F, 3)
    corners: sparse.csr_matrix  # (V, 3F), sums what corners of faces say
    rims: np.ndarray  # (R,) rows of ``edges``
    beyond: np.ndarray  # (R, 2) the rim's vertices before and after, -1 where it ends or has a corner

    def positions(self, pos: np.ndarray) -> np.ndarray:
        """(V + E, 3)."""
        start, end = pos[self.edges[:, 0]], pos[self.edges[:, 1]]
        normals, way = self._normals(pos), end - start
        first, second = normals[self.edges[:, 0]], normals[self.edges[:, 1]]
        bulge = (way * first).sum(axis=1, keepdims=True) * first - (way * second).sum(axis=1, keepdims=True) * second
        middle = (start + end) / 2.0 - bulge / 8.0
        one, other = start[self.rims], end[self.rims]
        before = np.where(self.beyond[:, :1] < 0, 2.0 * one - other, pos[self.beyond[:, 0]])
        after = np.where(self.beyond[:, 1:] < 0, 2.0 * other - one, pos[self.beyond[:, 1]])
        middle[self.rims] = (9.0 * (one + other) - before - after) / 16.0
        return np.concatenate([pos, middle])

    def _normals(self, pos: np.ndarray) -> np.ndarray:
        """Unit normals (V, 3); zero where there is none."""
        tips = pos[self.faces]
        normal = _unit(np.cross(tips[:, 1] - tips[:, 0], tips[:, 2] - tips[:, 0]))
        ways = _unit(np.roll(tips, -1, axis=1) - tips)  # from every corner to the next
        angles = np.arccos(np.clip(-(ways * np.roll(ways, 1, axis=1)).sum(axis=2), -1.0, 1.0))
        return _unit(self.corners @ (angles[:, :, None] * normal[:, None]).reshape(-1, 3))


def _level(faces: np.ndarray, rest_pos: np.ndarray) -> _Level:
    edges, count = unique_edges(faces), len(rest_pos)
    every = edge_index(edges, faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    rims = np.flatnonzero(np.bincount(every, minlength=len(edges)) != 2)
    rows, columns = faces.reshape(-1), np.arange(faces.size)
    corners = sparse.csr_matrix((np.ones(faces.size), (rows, columns)), shape=(count, faces.size))
    return _Level(faces, edges, quartered(faces, edges, count), corners, rims, _beyond(edges[rims], rest_pos))


def quartered(faces: np.ndarray, edges: np.ndarray, count: int) -> np.ndarray:
    """(4F, 3): faces between the ``count`` vertices and the new ones, which follow them in the order of ``edges``."""
    a, b, c = faces.T
    ab, bc, ca = (count + edge_index(edges, np.stack(pair, axis=1)) for pair in ((a, b), (b, c), (c, a)))
    return np.concatenate([np.stack(face, axis=1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def _beyond(rims: np.ndarray, rest_pos: np.ndarray) -> np.ndarray:
    """(R, 2): for edges of rims (R, 2) the vertices with which the rim goes on before and after them; -1 where it does not."""
    ends, others = np.concatenate([rims[:, 0], rims[:, 1]]), np.concatenate([rims[:, 1], rims[:, 0]])
    degree = np.bincount(ends, minlength=len(rest_pos))
    total = np.bincount(ends, weights=others, minlength=len(rest_pos)).astype(np.int64)  # of a vertex on a rim: its neighbours
    found = np.where(degree[ends] == 2, total[ends] - others, -1)
    came, goes = _unit(rest_pos[ends] - rest_pos[others]), _unit(rest_pos[found] - rest_pos[ends])
    turns = (came * goes).sum(axis=1) < np.cos(_CORNER)
    return np.where(turns, -1, found).reshape(2, -1).T


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Of length 1; zero where they have none."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))


class Extrusion:
    """The shell of a sheet, whatever its positions: numbers of its points and faces.

    Where more than two faces meet in an edge, or two that are wound against each other, the sheet is cut: each of its parts
    is closed by itself, and so is the whole.

    Args:
        faces: (F, 3) of the sheet.
        num_vertices: of the sheet, V.
        kept: (F,) bool, faces that stay as they are, as those of solid buttons.

    Attributes:
        vertex: (N,) vertex of the sheet that every point of the shell belongs to. The first V are these vertices, on the outer
            layer, the side that normals point to.
        faces: (G, 3) over points: the sheet's faces, in their order, then the inner layer and the strip.
        source: (G, 3) the sheet's corner, three times its face and its place there, whose texture coordinate each corner has.

    Example:
        >>> pos = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> shell = Extrusion(np.array([[0, 1, 2]]), 3)
        >>> len(shell.vertex), len(shell.faces), float(shell.positions(pos, np.full((3, 2), 0.005))[3:, 2].max())
        (6, 8, -0.005)
    """

    def __init__(self, faces: np.ndarray, num_vertices: int, kept: np.ndarray | None = None) -> None:
        faces = np.asarray(faces, dtype=np.int64)
        solid = np.zeros(len(faces), dtype=bool) if kept is None else kept
        corner, point, rims, self._sheet_vertex = _cut(faces, num_vertices)
        thick = corner[~solid]
        start, end = rims[~solid[rims[:, 0] // 3]].T
        strip = [np.stack(three, axis=1) for three in ((end, start, start), (end, start, end))]
        self.source = np.concatenate([corner, thick[:, ::-1], *strip])
        below = np.zeros(self.source.shape, dtype=bool)
        below[len(corner) : len(corner) + len(thick)] = True
        first = len(corner) + len(thick)
        below[first : first + len(start), 2] = True
        below[first + len(start) :, 1:] = True
        self._twin = np.unique(point[thick])
        number = np.zeros(len(self._sheet_vertex), dtype=np.int64)
        number[self._twin] = len(self._sheet_vertex) + np.arange(len(self._twin))
        outer = point[self.source]
        self.faces = np.where(below, number[outer], outer)
        self.vertex = np.concatenate([self._sheet_vertex, self._sheet_vertex[self._twin]])
        self._sheet = point[corner]

    def positions(self, pos: np.ndarray, layers: np.ndarray) -> np.ndarray:
        """Points (N, 3) [m] for vertices ``pos`` (V, 3): the outer and the inner layer are at distances ``layers`` (V, 2) [m]
        from them, along the mean normal of the faces around, weighted by their areas. Faces that are kept do not move."""
        points = np.asarray(pos, dtype=np.float64)[self._sheet_vertex]
        a, b, c = (points[self._sheet[:, k]] for k in range(3))
        cross, normal = np.cross(b - a, c - a), np.zeros_like(points)
        for axis in range(3):
            share = np.repeat(cross[:, axis], 3)
            normal[:, axis] = np.bincount(self._sheet.reshape(-1), share, len(points))
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        below = points[self._twin] - layers[self._sheet_vertex[self._twin], 1, None] * normal[self._twin]
        points[self._twin] += layers[self._sheet_vertex[self._twin], 0, None] * normal[self._twin]
        return np.concatenate([points, below])


def _cut(faces: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Numbers (F, 3) of the corners of faces, the point (3F,) that each is at where the sheet is cut, the corners (B, 2) at
    the ends of open edges, as their face runs along them, and the vertex (P,) of every point, the first of each vertex
    being its own."""
    corner = np.arange(faces.size).reshape(-1, 3)
    vertex = faces.reshape(-1)
    start, end = corner.reshape(-1), np.roll(corner, -1, axis=1).reshape(-1)
    low, high = np.minimum(vertex[start], vertex[end]), np.maximum(vertex[start], vertex[end])
    forward = vertex[start] == low
    # Along an edge the first face that runs up is joined with the first that runs down, the second with the second.
    key = low * (int(vertex.max(initial=0)) + 1) + high
    order = np.lexsort((start, forward, key))
    runs = np.concatenate([[True], (key[order][1:] != key[order][:-1]) | (forward[order][1:] != forward[order][:-1])])
    begin = np.flatnonzero(runs)
    rank = np.empty(len(start), dtype=np.int64)
    rank[order] = np.arange(len(start)) - begin[np.cumsum(runs) - 1]
    order = np.lexsort((forward, rank, key))
    same = np.flatnonzero((key[order][1:] == key[order][:-1]) & (rank[order][1:] == rank[order][:-1]))
    one, other = order[same], order[same + 1]
    pairs = np.concatenate([np.stack([start[one], end[other]], axis=1), np.stack([end[one], start[other]], axis=1)])
    fan = connected_components(faces.size, pairs)
    open_edge = np.ones(len(start), dtype=bool)
    open_edge[np.concatenate([one, other])] = False
    # Fans are numbered by their first corners: the first of a vertex takes its number, others come after all vertices.
    of_fan = vertex[np.unique(fan, return_index=True)[1]]
    firsts = np.unique(of_fan, return_index=True)[1]
    number = np.full(len(of_fan), -1)
    number[firsts] = of_fan[firsts]
    further = np.flatnonzero(number < 0)
    number[further] = num_vertices + np.arange(len(further))
    return corner, number[fan], np.stack([start, end], axis=1)[open_edge], np.append(np.arange(num_vertices), of_fan[further])
