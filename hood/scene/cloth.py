"""The static cloth of a scene: topology, rest shape and fabric of one or several garments, as flat tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.mesh import geometry, topology
from hood.scene.batch import concatenate, indexes


@dataclass(frozen=True)
class Cloth:
    """B garments, concatenated. Derived fields (masses, rest quantities) are constant during a rollout.

    Fabric fields live where the energies need them (faces, hinges); ``vertex_fabric`` and ``edge_fabric`` hold
    (lame_mu [Pa], lame_lambda [Pa], bending_stiffness) where the network's features need them.
    """

    rest_pos: Tensor  # (V, 3) m
    faces: Tensor = indexes("vertices")  # (F, 3)
    edges: Tensor = indexes("vertices")  # (E, 2) unique, undirected
    hinges: Tensor = indexes("vertices")  # (H, 4) edge start, edge end, opposite vertex of each face
    vertex_scene: Tensor = indexes("scenes")  # (V,)
    edge_scene: Tensor = indexes("scenes")  # (E,)
    face_scene: Tensor = indexes("scenes")  # (F,)
    hinge_scene: Tensor = indexes("scenes")  # (H,)
    pinned: Tensor = None  # type: ignore[assignment]  # (V,) bool
    # fabric
    density: Tensor = None  # type: ignore[assignment]  # (F,) kg/m²
    thickness: Tensor = None  # type: ignore[assignment]  # (F,) m
    lame_mu: Tensor = None  # type: ignore[assignment]  # (F,) Pa
    lame_lambda: Tensor = None  # type: ignore[assignment]  # (F,) Pa
    bending_stiffness: Tensor = None  # type: ignore[assignment]  # (H,)
    vertex_fabric: Tensor = None  # type: ignore[assignment]  # (V, 3)
    edge_fabric: Tensor = None  # type: ignore[assignment]  # (E, 3)
    # derived from the rest shape
    mass: Tensor = None  # type: ignore[assignment]  # (V,) kg
    rest_area: Tensor = None  # type: ignore[assignment]  # (F,) m²
    rest_inverse: Tensor = None  # type: ignore[assignment]  # (F, 2, 2) 1/m, inverse of the rest edge matrix
    rest_length: Tensor = None  # type: ignore[assignment]  # (H,) m, hinge edge at rest
    hinge_area: Tensor = None  # type: ignore[assignment]  # (H,) m², sum of the two faces at rest
    rest_angle: Tensor = None  # type: ignore[assignment]  # (H,) rad
    num_scenes: int = 1

    @property
    def num_vertices(self) -> int:
        return self.rest_pos.shape[0]

    @property
    def free(self) -> Tensor:
        """Vertices that the simulation moves, (V,) bool: neither pinned nor isolated (massless)."""
        return ~self.pinned & (self.mass > 0)


def build_cloth(
    rest_pos: np.ndarray,
    faces: np.ndarray,
    material: Material,
    pinned: np.ndarray | None = None,
    flat_rest: bool = False,
    dtype: torch.dtype = torch.float32,
) -> Cloth:
    """Cloth of one garment.

    Args:
        rest_pos: (V, 3) [m], the undeformed garment.
        faces: (F, 3) vertex indices.
        material: fabric; each property a scalar or a field of shape (V,).
        pinned: (V,) bool, vertices that follow prescribed positions.
        flat_rest: take 0 as rest angle of every hinge instead of the angle in ``rest_pos``.
    """
    num_vertices = len(rest_pos)
    # Rest quantities are differences of positions: computed in float64, stored in the working precision.
    pos = torch.as_tensor(np.asarray(rest_pos, dtype=np.float64))
    tri = torch.as_tensor(np.asarray(faces, dtype=np.int64))
    edges = torch.as_tensor(topology.unique_edges(np.asarray(faces)))
    hinge_table = topology.hinges(np.asarray(faces))
    hinges = torch.as_tensor(hinge_table.vertices)
    hinge_faces = torch.as_tensor(hinge_table.faces)
    area = geometry.triangle_areas(pos, tri)
    fields = {name: _vertex_field(name, getattr(material, name), num_vertices) for name in Material.names()}
    density = fields["density"][tri].mean(dim=1)
    fabric = torch.stack([fields["lame_mu"], fields["lame_lambda"], fields["bending_stiffness"]], dim=1)
    angle = geometry.dihedral_angles(pos, hinges)
    real = {
        "rest_pos": pos,
        "density": density,
        "thickness": fields["thickness"][tri].mean(dim=1),
        "lame_mu": fields["lame_mu"][tri].mean(dim=1),
        "lame_lambda": fields["lame_lambda"][tri].mean(dim=1),
        "bending_stiffness": fields["bending_stiffness"][hinges[:, :2]].mean(dim=1),
        "vertex_fabric": fabric,
        "edge_fabric": fabric[edges].mean(dim=1),
        "mass": geometry.vertex_masses(pos, tri, density),
        "rest_area": area,
        "rest_inverse": geometry.rest_inverse(pos, tri),
        "rest_length": (pos[hinges[:, 1]] - pos[hinges[:, 0]]).norm(dim=1),
        "hinge_area": area[hinge_faces].sum(dim=1),
        "rest_angle": torch.zeros_like(angle) if flat_rest else angle,
    }
    pin = torch.zeros(num_vertices, dtype=torch.bool) if pinned is None else torch.as_tensor(pinned).bool()
    return Cloth(
        faces=tri,
        edges=edges,
        hinges=hinges,
        vertex_scene=torch.zeros(num_vertices, dtype=torch.int64),
        edge_scene=torch.zeros(len(edges), dtype=torch.int64),
        face_scene=torch.zeros(len(tri), dtype=torch.int64),
        hinge_scene=torch.zeros(len(hinges), dtype=torch.int64),
        pinned=pin,
        num_scenes=1,
        **{name: value.to(dtype) for name, value in real.items()},
    )


def concatenate_cloths(cloths: Sequence[Cloth]) -> Cloth:
    """Several cloths as one flat batch; scene *i* of the result is the *i*-th scene of the inputs in order."""
    counts = {"vertices": [c.num_vertices for c in cloths], "scenes": [c.num_scenes for c in cloths]}
    return concatenate(cloths, counts)


def _vertex_field(name: str, value: float | np.ndarray | Tensor, num_vertices: int) -> Tensor:
    array = torch.as_tensor(value, dtype=torch.float64)
    if array.ndim == 0:
        return array.expand(num_vertices)
    if array.shape != (num_vertices,):
        raise ValueError(
            f"material {name!r} has shape {tuple(array.shape)}; give one number or one per vertex ({num_vertices},)"
        )
    return array
