"""Contact, friction and drag at points inside the cloth's edges and faces, each a weighted sum of up to three vertices.

Energies at a point x_p = Σ w_i x_i pull vertex i with w_i times the force at the point, and couple vertices i and j by w_i w_j
times the second derivative there. The vertices of a point share an edge or a face, so that this lies within the pattern of
the Hessian.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.term import Form, having
from hood.energies.wind import Drag
from hood.solver.derivatives.vertices import VertexForces, VertexModel
from hood.solver.system.sparsity import BlockPattern
from hood.tensors.dense import add_rows


@dataclass(frozen=True)
class PointForces:
    """Contact, friction and drag at N points."""

    vertices: Tensor  # (N, 3)
    weights: Tensor  # (N, 3), 0 where a point has fewer vertices
    scene: Tensor  # (N,)
    forces: VertexForces  # on the points, as on vertices without mass
    centroids: bool = False  # of all faces, in their order: known before the step

    def take(self, rows: Tensor) -> PointForces:
        """Those at some points."""
        return PointForces(self.vertices[rows], self.weights[rows], self.scene[rows], self.forces.take(rows))

    def at(self, values: Tensor) -> Tensor:
        """``values`` (V, 3) of vertices at the points, (N, 3)."""
        return (self.weights.unsqueeze(2) * values[self.vertices]).sum(dim=1)

    def energies(self, pos: Tensor) -> list[Tensor]:
        """Energies [J] (N,) of the terms at positions (V, 3) of the vertices."""
        return self.forces.contact_energies(self.at(pos))

    def model(self, pos: Tensor) -> VertexModel:
        """Derivatives by the points at positions (V, 3) of the vertices."""
        here = self.at(pos)
        return self.forces.model(here, torch.zeros_like(here))

    def spread(self, gradient: Tensor, like: Tensor) -> Tensor:
        """Gradients (N, 3) by the points as one by vertices ``like`` (V, 3)."""
        shares = self.weights.unsqueeze(2) * gradient.unsqueeze(1)
        return add_rows(torch.zeros_like(like), self.vertices.reshape(-1), shares.reshape(-1, 3))

    def spread_blocks(self, matrix: Tensor, num_vertices: int) -> Tensor:
        """Diagonal blocks (V, 3, 3) of the vertices, of matrices (N, 3, 3) by the points."""
        shares = self.weights[:, :, None, None] ** 2 * matrix.unsqueeze(1)
        return add_rows(matrix.new_zeros(num_vertices, 3, 3), self.vertices.reshape(-1), shares.reshape(-1, 3, 3))


def point_forces(potential: Potential, problem: StepProblem) -> tuple[PointForces, ...]:
    """The potential's terms that act at points inside edges and faces, place by place."""
    active = potential.active(problem)
    planes, grips = (list(having(active, form).values()) for form in (Form.PLANES, Form.GRIPS))
    found = []
    for points in problem.point_contacts:
        there = [[term.closed_form_at(problem, points) for term in terms] for terms in (planes, grips)]
        walls, held = (tuple(one for one in terms if one is not None) for terms in there)
        if walls or held:
            none = torch.zeros_like(points.dist)
            forces = VertexForces(none[:, None], none, torch.zeros_like(points.point), walls, held)
            found.append(PointForces(points.vertices, points.weights, points.scene, forces))
    drags = tuple(term.closed_form(problem) for term in having(active, Form.DRAG).values())
    return (*found, _at_centroids(problem, drags)) if drags else tuple(found)


def _at_centroids(problem: StepProblem, drags: tuple[Drag, ...]) -> PointForces:
    """Drag on the faces, in equal shares of their corners."""
    cloth, none = problem.cloth, torch.zeros_like(drags[0].across)
    forces = VertexForces(none[:, None], none, torch.zeros_like(drags[0].normal), (), (), drags)
    thirds = torch.full_like(drags[0].normal, 1.0 / 3.0)
    return PointForces(cloth.faces, thirds, cloth.face_scene, forces, centroids=True)


@dataclass(frozen=True)
class PointBlocks:
    """Adds the matrices of N points to a matrix of the free vertices."""

    kept: Tensor  # (K,) which rows of the points' products are rows of the matrix
    target: Tensor  # (K,) and which
    products: Tensor  # (N, 9) of the weights of two corners

    def add(self, triples: Tensor, matrix: Tensor) -> Tensor:
        """``triples`` (R, 3) of the pattern with matrices (N, 3, 3) by the points."""
        blocks = self.products.to(matrix)[:, :, None, None] * matrix[:, None]
        return add_rows(triples, self.target, blocks.reshape(-1, 3)[self.kept])


def point_blocks(pattern: BlockPattern, vertices: np.ndarray, weights: Tensor, unknown: np.ndarray) -> PointBlocks:
    """Blocks of points at ``vertices`` (N, 3) with ``weights`` (N, 3); ``unknown`` (V,) are the numbers of the free vertices,
    -1 for the others."""
    corners, pairs = unknown[vertices], list(product(range(3), repeat=2))
    target = np.stack([pattern.triples(corners[:, a], corners[:, b]) for a, b in pairs], axis=1).reshape(-1)
    kept = torch.as_tensor(np.flatnonzero(target >= 0), device=weights.device)
    products = torch.stack([weights[:, a] * weights[:, b] for a, b in pairs], dim=1)
    return PointBlocks(kept, torch.as_tensor(target, device=weights.device)[kept], products)
