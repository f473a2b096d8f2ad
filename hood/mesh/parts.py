"""The connected parts of a mesh: where each begins, its rims, its size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hood.mesh import topology


class Part(NamedTuple):
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


def find_parts(pos: np.ndarray, faces: np.ndarray) -> list[Part]:
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
            Part(
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
