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


def patchwork(material: Material, parts: Sequence[tuple[np.ndarray, Material]], pos: np.ndarray, faces: np.ndarray) -> Material:
    """A fabric of which some faces are others, each property a field on faces.

    Away from the seams every part is what a garment of its own fabric would be. The bend of an edge between two fabrics is the
    mean of both.

    Args:
        material: of all other faces.
        parts: masks (F,) bool and their fabrics; of several that hold a face the last counts.
        pos: (V, 3) m at rest.
        faces: (F, 3).
    """
    edges = topology.unique_edges(faces)
    corners = pos[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    whole, others = (
        [FabricMap(fabric, len(pos), faces, edges, area) for fabric in fabrics]
        for fabrics in ([material], [fabric for _, fabric in parts])
    )
    fields = {}
    for name in Material.names():
        values = whole[0].on_faces(name).copy()
        for (mask, _), own in zip(parts, others, strict=True):
            values[mask] = own.on_faces(name)[mask]
        fields[name] = FaceField(values)
    return Material(**fields)


#: What a garment's stiffness multiplies.
_STIFFENED = ("lame_mu", "lame_lambda")
_PLURAL = {"vertex": "vertices", "face": "faces", "edge": "edges"}
