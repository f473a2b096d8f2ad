"""A fabric's properties where they are needed: carried between vertices, faces and edges by one rule per pair.

| given on | on vertices | on faces | on edges |
|---|---|---|---|
| one number | that number | that number | that number |
| vertices | as given | mean of the three corners | mean of the two ends |
| faces | mean of the faces around, weighted by rest area | as given | mean of the faces at the edge |
| edges | mean of the edges around | mean of the three edges | as given |

A property given where it is needed is used as it is. Hinges take the value of their edge. The area-weighted mean keeps
the mass: a vertex has a third of every face around it. Isolated vertices have the mean of the garment; nothing but the
network's features reads it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix, vstack
from scipy.sparse.csgraph import dijkstra

from hood.assets.material import FaceField, Material, check_lame, values_of
from hood.mesh import topology


class FabricMap:
    """Reads the properties of ``material`` on the vertices, faces and edges of one mesh, all in float64.

    Args:
        num_vertices: V.
        faces: (F, 3).
        edges: (E, 2), :func:`hood.mesh.topology.unique_edges` of the faces.
        area: (F,) m² at rest.
        stiffness: (V,) factors on ``lame_mu`` and ``lame_lambda``, carried over like a property given on vertices; None: 1.

    Raises:
        ValueError: a field or ``stiffness`` has the wrong length, or μ + λ is not positive on a face.
    """

    def __init__(
        self,
        material: Material,
        num_vertices: int,
        faces: np.ndarray,
        edges: np.ndarray,
        area: np.ndarray,
        stiffness: np.ndarray | None = None,
    ) -> None:
        if stiffness is not None and stiffness.shape != (num_vertices,):
            raise ValueError(f"stiffness has shape {stiffness.shape}; give one factor per vertex ({num_vertices},)")
        self._stiffness = stiffness
        self.faces, self.edges, self.area = faces, edges, area
        self._counts = {"vertex": num_vertices, "face": len(faces), "edge": len(edges)}
        self._values = {name: values_of(getattr(material, name)) for name in Material.names()}
        for name, (values, place) in self._values.items():
            if place and values.shape != (self._counts[place],):
                raise ValueError(
                    f"material {name!r} has shape {values.shape} on {_PLURAL[place]}; give one number, or one per {place} "
                    f"({self._counts[place]},)"
                )
        # Positive where both were given does not make it positive where they meet.
        check_lame(self.on_faces("lame_mu"), self.on_faces("lame_lambda"), "face")

    def on_vertices(self, name: str) -> np.ndarray:
        """(V,) values of a property."""
        return self._stiffened(name, self._on_vertices(name), None)

    def _on_vertices(self, name: str) -> np.ndarray:
        values, place = self._values[name]
        if place == "face":
            return self._gather(self.faces, values, self.area)
        if place == "edge":
            return self._gather(self.edges, values, np.ones(len(self.edges)))
        return self._broadcast(values, "vertex")

    def on_faces(self, name: str) -> np.ndarray:
        """(F,) values of a property."""
        return self._stiffened(name, self._on_faces(name), self.faces)

    def _on_faces(self, name: str) -> np.ndarray:
        values, place = self._values[name]
        if place == "vertex":
            return values[self.faces].mean(axis=1)
        if place == "edge":
            return values[self._face_edges].mean(axis=1)
        return self._broadcast(values, "face")

    def on_edges(self, name: str) -> np.ndarray:
        """(E,) values of a property."""
        return self._stiffened(name, self._on_edges(name), self.edges)

    def _on_edges(self, name: str) -> np.ndarray:
        values, place = self._values[name]
        if place == "vertex":
            return values[self.edges].mean(axis=1)
        if place == "face":
            edge = self._face_edges.reshape(-1)
            total = np.bincount(edge, np.repeat(values, 3), len(self.edges))
            return total / np.bincount(edge, minlength=len(self.edges))
        return self._broadcast(values, "edge")

    def _stiffened(self, name: str, values: np.ndarray, elements: np.ndarray | None) -> np.ndarray:
        """``values`` of a property on vertices, or on elements (N, C), with the factors that it has there."""
        if self._stiffness is None or name not in _STIFFENED:
            return values
        return values * (self._stiffness if elements is None else self._stiffness[elements].mean(axis=1))

    @cached_property
    def _face_edges(self) -> np.ndarray:
        """(F, 3) edges of every face."""
        sides = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        return topology.edge_index(self.edges, sides).reshape(-1, 3)

    def _gather(self, elements: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Weighted mean (V,) over the elements (N, C) around every vertex."""
        count, corners = self._counts["vertex"], elements.shape[1]
        total = np.bincount(elements.reshape(-1), np.repeat(weight, corners), count)
        mixed = np.bincount(elements.reshape(-1), np.repeat(weight * values, corners), count)
        isolated = total == 0
        return np.where(isolated, np.average(values, weights=weight), mixed / np.where(isolated, 1.0, total))

    def _broadcast(self, values: np.ndarray, place: str) -> np.ndarray:
        return np.broadcast_to(values, (self._counts[place],))


def patchwork(
    material: Material,
    parts: Sequence[tuple[np.ndarray, Material]],
    pos: np.ndarray,
    faces: np.ndarray,
    seam_width: float = 0.0,
) -> Material:
    """A fabric of which some faces are others, each property a field on faces.

    Away from the seams every part is what a garment of its own fabric would be. The bend of an edge between two fabrics is the
    mean of both.

    Args:
        material: of all other faces.
        parts: masks (F,) bool and their fabrics; of several that hold a face the last counts.
        pos: (V, 3) m at rest.
        faces: (F, 3).
        seam_width: m, along the cloth, over which one fabric becomes the other: a face there has the mean of the faces within
            half of it, the nearer the more. 0: from one face to the next.
    """
    edges = topology.unique_edges(faces)
    corners = pos[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    whole, others = (
        [FabricMap(fabric, len(pos), faces, edges, area) for fabric in fabrics]
        for fabrics in ([material], [fabric for _, fabric in parts])
    )
    label = np.zeros(len(faces), dtype=np.int64)
    for number, (mask, _) in enumerate(parts):
        label[mask] = number + 1
    near, shares = _around_seams(label, corners.mean(axis=1), faces, area, 0.5 * seam_width)
    fields = {}
    for name in Material.names():
        values = whole[0].on_faces(name).copy()
        for (mask, _), own in zip(parts, others, strict=True):
            values[mask] = own.on_faces(name)[mask]
        values[near] = shares @ values
        fields[name] = FaceField(values)
    return Material(**fields)


def _around_seams(
    label: np.ndarray, centre: np.ndarray, faces: np.ndarray, area: np.ndarray, reach: float
) -> tuple[np.ndarray, csr_matrix]:
    """Faces (N,) within ``reach`` [m] along the cloth of a face with another ``label`` (F,), and (N, F) the shares that the
    faces around have in them; rows sum to 1.

    Args:
        centre: (F, 3) m of the faces.
        area: (F,) m².
    """
    nothing = np.zeros(0, dtype=np.int64), csr_matrix((0, len(faces)))
    if reach <= 0.0:
        return nothing
    # Faces that share a vertex: over edges alone ways along the cloth go to and fro, and are half as long again.
    corner = csr_matrix((np.ones(faces.size), (np.arange(faces.size) // 3, faces.ravel())))
    first, second = (corner @ corner.T).nonzero()
    seam = np.unique(first[label[first] != label[second]])
    if not len(seam):
        return nothing
    # A way of length 0 is none in a sparse matrix.
    length = np.maximum(np.linalg.norm(centre[first] - centre[second], axis=1), 1e-12)
    graph = csr_matrix((length, (first, second)))
    near = np.flatnonzero(np.isfinite(dijkstra(graph, indices=seam, limit=reach, min_only=True)))
    rows, solid = [], np.maximum(area, np.finfo(np.float64).tiny)
    for some in np.array_split(near, max(len(near) // _FACES_AT_ONCE, 1)):
        distance = dijkstra(graph, indices=some, limit=reach)
        weight = np.where(np.isfinite(distance), solid * np.maximum(1.0 - distance / reach, 0.0), 0.0)
        rows.append(csr_matrix(weight / weight.sum(axis=1, keepdims=True)))
    return near, vstack(rows).tocsr()


#: Rows of distances that are held at a time.
_FACES_AT_ONCE = 256
#: What a garment's stiffness multiplies.
_STIFFENED = ("lame_mu", "lame_lambda")
_PLURAL = {"vertex": "vertices", "face": "faces", "edge": "edges"}
