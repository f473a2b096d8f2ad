"""The connected parts of a mesh: where each begins, its rims, its size.

Small things that ride on cloth: each group of vertices moves as a rigid body with the cloth beneath it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hood.mesh import topology
from hood.mesh.topology import connected_components


class MeshPart(NamedTuple):
    """What hangs together by faces."""

    number: int  # from 1, in the order of their first vertices
    vertices: np.ndarray  # (n,) ascending
    faces: np.ndarray  # (m,) rows of the mesh's faces, ascending
    rims: tuple[np.ndarray, ...]  # loops of vertices, longest first; none: it is closed
    area: float  # in squares of the mesh's unit
    low: np.ndarray  # (3,) of its box
    high: np.ndarray  # (3,)
    num_edges: int

    @property
    def extent(self) -> float:
        """The longest side of its box."""
        return float((self.high - self.low).max())

    @property
    def closed(self) -> bool:
        return not self.rims

    @property
    def can_be_put_on(self) -> bool:
        """Whether something can be in it, as in a tube: not in a sheet, nor in a ball. Euler's V − E + F is 1 and 2 for
        these, and less for all else, also where a lining that is sewn to the rims leaves none open."""
        return len(self.vertices) - self.num_edges + len(self.faces) <= 0


def part_labels(num_vertices: int, faces: np.ndarray) -> np.ndarray:
    """The part (V,) that each vertex is of, from 0 in the order of :func:`find_parts`; -1 of vertices of no face."""
    return _labels(num_vertices, faces, topology.unique_edges(faces))


def _labels(num_vertices: int, faces: np.ndarray, edges: np.ndarray) -> np.ndarray:
    label = topology.connected_components(num_vertices, edges)
    used = np.zeros(num_vertices, dtype=bool)
    used[faces.reshape(-1)] = True
    known, number = np.unique(label[used], return_inverse=True)
    found = np.full(num_vertices, -1, dtype=np.int64)
    found[used] = number
    assert len(known) == number.max(initial=-1) + 1
    return found


def find_parts(pos: np.ndarray, faces: np.ndarray) -> list[MeshPart]:
    """The parts of the mesh ``pos`` (V, 3), ``faces`` (F, 3)."""
    all_edges = topology.unique_edges(faces)
    label = _labels(len(pos), faces, all_edges)
    of_faces = label[faces[:, 0]]
    corners = pos[faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rims: dict[int, list[np.ndarray]] = {}
    for loop in topology.boundary_loops(faces):
        rims.setdefault(int(label[loop[0]]), []).append(loop)
    by_vertex, by_face = _rows(label), _rows(of_faces)
    edges = np.bincount(label[all_edges[:, 0]], minlength=1)
    found = []
    for number, vertices in by_vertex.items():
        rows, box = by_face[number], pos[vertices]
        loops = tuple(rims.get(number, ()))
        found.append(
            MeshPart(
                number + 1,
                vertices,
                rows,
                loops,
                float(areas[rows].sum()),
                box.min(axis=0),
                box.max(axis=0),
                int(edges[number]),
            )
        )
    return found


def _rows(label: np.ndarray) -> dict[int, np.ndarray]:
    """Rows (n,) of every label from 0 on, ascending."""
    order = np.argsort(label, kind="stable")
    order = order[label[order] >= 0]
    if not len(order):
        return {}
    starts = np.flatnonzero(np.r_[True, np.diff(label[order]) > 0])
    return {int(label[rows[0]]): rows for rows in np.split(order, starts[1:])}


def rim_length(pos: np.ndarray, rim: np.ndarray) -> float:
    """Length of a closed loop of vertices (n,) of ``pos`` (V, 3)."""
    return float(np.linalg.norm(pos[rim] - np.roll(pos[rim], 1, axis=0), axis=1).sum())


def num_through(rim: np.ndarray, body_pos: np.ndarray, body_edges: np.ndarray) -> int:
    """How many edges of the body go through the fan of triangles between an opening (N, 3) [m] and its middle."""
    low, high = rim.min(axis=0), rim.max(axis=0)
    near = body_edges
    for axis in np.argsort(high - low):  # the shortest side of the rim's box leaves the fewest edges
        first, second = body_pos[near[:, 0], axis], body_pos[near[:, 1], axis]
        near = near[(np.minimum(first, second) <= high[axis]) & (np.maximum(first, second) >= low[axis])]
    if not len(near):
        return 0
    start = body_pos[near[:, 0]]
    way = body_pos[near[:, 1]] - start
    middle = rim.mean(axis=0)
    first, second = rim - middle, np.roll(rim, -1, axis=0) - middle  # sides of the triangles, (N, 3)
    normal = np.cross(first, second)
    slope = way @ normal.T  # (E, N)
    from_middle = start - middle
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -(from_middle @ normal.T) / slope
        crossed = np.cross(way, from_middle)
        u = (crossed @ second.T) / slope
        v = -(crossed @ first.T) / slope
        hit = (along >= 0.0) & (along <= 1.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
    return int(hit.any(axis=1).sum())


#: Of the cloth around its nearest triangle a rigid thing follows what lies within its own reach and this [m], so many vertices.
_AROUND, _MOST = 0.01, 24


@dataclass(frozen=True)
class Riders:
    """Vertices and faces beside a cloth, which are no part of its simulation.

    A group of riders takes the rigid motion that brings its anchors, vertices of the cloth, nearest to where they are (Kabsch).
    """

    pos: np.ndarray  # (R, 3) m, where the cloth is at rest
    faces: np.ndarray  # (N, 3) between them
    group: np.ndarray  # (R,) from 0
    anchors: np.ndarray  # (A,) vertices of the cloth
    anchor_group: np.ndarray  # (A,) the group that follows each; every group has some
    uv_faces: np.ndarray | None = None  # (N, 3) into the texture coordinates of the garment

    @property
    def num_groups(self) -> int:
        """How many groups there are."""
        return int(self.group.max(initial=-1)) + 1

    @property
    def first_anchor(self) -> np.ndarray:
        """(R,) a vertex of the cloth that stands for each rider, such as for its garment."""
        first = np.zeros(self.num_groups, dtype=np.int64)
        first[self.anchor_group[::-1]] = self.anchors[::-1]
        return first[self.group]

    def positions(self, pos: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """(R, 3) [m] where the cloth is at ``pos`` (V, 3), and at rest at ``rest`` (V, 3); NaN where its anchors are that."""
        number = np.bincount(self.anchor_group, minlength=self.num_groups)[:, None]
        here, there = rest[self.anchors], pos[self.anchors]
        middle, target = (_sums(values, self.anchor_group, self.num_groups) / number for values in (here, there))
        product = (there - target[self.anchor_group])[:, :, None] * (here - middle[self.anchor_group])[:, None, :]
        turn = _nearest_turns(_sums(product.reshape(-1, 9), self.anchor_group, self.num_groups).reshape(-1, 3, 3))
        offset = self.pos - middle[self.group]
        return np.asarray(target[self.group] + np.einsum("rij,rj->ri", turn[self.group], offset))

    def renumbered(self, number: np.ndarray) -> Riders | None:
        """The riders on a cloth whose vertices have the numbers ``number`` (V,), -1 if gone; those that lose every anchor are
        gone as well. None without any."""
        anchors = number[self.anchors]
        there = anchors >= 0
        kept = np.zeros(self.num_groups, dtype=bool)
        kept[self.anchor_group[there]] = True
        rank = np.cumsum(kept) - 1
        rows = kept[self.group]
        if not rows.any():
            return None
        vertex, whole = np.cumsum(rows) - 1, rows[self.faces].all(axis=1)
        return Riders(
            self.pos[rows], vertex[self.faces[whole]], rank[self.group[rows]], anchors[there], rank[self.anchor_group[there]],
            None if self.uv_faces is None else self.uv_faces[whole],
        )  # fmt: skip


def join_riders(riders: Sequence[Riders | None], starts: Sequence[int], uv_starts: Sequence[int]) -> Riders | None:
    """The riders of cloths that are joined, whose vertices begin at ``starts`` and texture coordinates at ``uv_starts``; None
    where none has any."""
    found: Riders | None = None
    for own, start, uv_start in zip(riders, starts, uv_starts, strict=True):
        if own is None:
            continue
        uv = None if own.uv_faces is None else own.uv_faces + uv_start
        own = replace(own, anchors=own.anchors + start, uv_faces=uv)
        found = own if found is None else _both(found, own)
    return found


def _both(first: Riders, second: Riders) -> Riders:
    textured = first.uv_faces is not None and second.uv_faces is not None
    return Riders(
        np.concatenate([first.pos, second.pos]),
        np.concatenate([first.faces, second.faces + len(first.pos)]),
        np.concatenate([first.group, second.group + first.num_groups]),
        np.concatenate([first.anchors, second.anchors]),
        np.concatenate([first.anchor_group, second.anchor_group + first.num_groups]),
        np.concatenate([first.uv_faces, second.uv_faces]) if textured else None,  # type: ignore[list-item]
    )


def rigid_anchors(pos: np.ndarray, cloth: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The vertices (n,) that a rigid thing at ``pos`` (r, 3) [m] follows: the ``corners`` (3,) of the triangle that it lies on,
    and the nearest of the cloth's (V, 3) around."""
    middle = 0.5 * (pos.min(axis=0) + pos.max(axis=0))
    reach = 0.5 * float(np.linalg.norm(np.ptp(pos, axis=0))) + _AROUND
    dist = np.linalg.norm(cloth - middle, axis=1)
    near = np.flatnonzero(dist <= reach)
    return np.union1d(corners, near[np.argsort(dist[near], kind="stable")][:_MOST])


def clusters(pos: Sequence[np.ndarray], near: float) -> np.ndarray:
    """Labels (n,) of point sets (r, 3): those within ``near`` of each other are one."""
    owner = np.repeat(np.arange(len(pos)), [len(points) for points in pos])
    pairs = cKDTree(np.concatenate(pos)).query_pairs(near, output_type="ndarray")
    return connected_components(len(pos), owner[pairs])


def _sums(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, group, values)
    return total


def _nearest_turns(matrices: np.ndarray) -> np.ndarray:
    """Rotations (G, 3, 3) nearest to ``matrices`` (G, 3, 3); NaN where those are not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    left, _, right = np.linalg.svd(np.where(finite[:, None, None], matrices, np.eye(3)))
    mirror = np.tile(np.eye(3), (len(matrices), 1, 1))
    mirror[:, 2, 2] = np.where(np.linalg.det(left @ right) < 0.0, -1.0, 1.0)
    return np.where(finite[:, None, None], left @ mirror @ right, np.nan)
