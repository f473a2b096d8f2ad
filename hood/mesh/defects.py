"""Defects of a triangle mesh, counted, with first examples; nothing is changed or refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hood.mesh import repair, topology

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
    alone = repair.isolated_vertices(len(pos), faces)
    component = topology.connected_components(len(pos), edges)
    welded = repair.weld(pos, faces, repair.weld_tolerance(pos, faces))
    broken = repair.broken_faces(pos, faces)
    sound, crowded = faces[~broken], _crowded_edges(faces)
    return Defects(
        num_components=len(np.unique(component[~alone])),
        openings=tuple(len(loop) for loop in topology.boundary_loops(faces)),
        non_manifold_edges=len(crowded),
        crowded_edges=tuple((int(a), int(b)) for a, b in crowded[:_EXAMPLES]),
        broken_faces=int(broken.sum()),
        duplicate_faces=int(repair.duplicate_faces(faces).sum()),
        isolated_vertices=int(alone.sum()),
        flipped_faces=int(repair.flipped_faces(sound).sum()),
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
