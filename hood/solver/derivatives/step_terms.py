"""The potential of one step with everything constant gathered once: its energies, and derivatives element by element.

The numbers are those of :class:`hood.energies.potential.Potential`, to rounding, in a third of the time: the tables that
every iteration reads lie as its arithmetic wants them.

Contact, friction and drag at points inside the cloth's edges and faces, each a weighted sum of up to three vertices.

Energies at a point x_p = Σ w_i x_i pull vertex i with w_i times the force at the point, and couple vertices i and j by w_i w_j
times the second derivative there. The vertices of a point share an edge or a face, so that this lies within the pattern of
the Hessian.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.energies.bending import HingeForm
from hood.energies.mass_points import attachment_targets
from hood.energies.potential import Potential, Term
from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import BlockForm, Form, having
from hood.energies.wind import Drag
from hood.solver.derivatives import elements
from hood.solver.derivatives.elements import Corners
from hood.solver.derivatives.vertices import VertexForces, VertexModel, terms_without_form, vertex_forces
from hood.solver.system.sparsity import BlockPattern
from hood.tensors.dense import add_rows, is_followed


class StepTerms:
    """Energies and derivatives of a potential for one step."""

    def __init__(self, potential: Potential, problem: StepProblem) -> None:
        self.problem = problem
        cloth, active = problem.cloth, potential.active(problem)
        self.vertices = vertex_forces(potential, problem)
        self.points = point_forces(potential, problem)
        self.bendings: list[HingeForm] = _forms(active, problem, Form.HINGES)
        self.springs = list(having(active, Form.SPRINGS).values())
        self.blocks: list[BlockForm] = _forms(active, problem, Form.BLOCKS)
        self.others = terms_without_form(potential, problem)
        targets = attachment_targets(problem) if self.springs else None
        self.spring_targets = None if targets is None else targets.t()  # (3, A) m
        num_membranes = len(having(active, Form.MEMBRANE))
        self.has_membrane = num_membranes > 0
        self.face_constants = elements.face_constants(cloth, num_membranes)
        self.hinge_constants = elements.hinge_constants(cloth)
        rate = stretch_rate(potential, problem)
        if rate is not None:
            self.face_constants = self.face_constants.damped(rate, problem.state.pos, cloth.faces)
        if any(form.damping is not None for form in self.bendings):
            dt = problem.step.dt[cloth.hinge_scene]
            self.hinge_constants = self.hinge_constants.moving(problem.state.pos, cloth.hinges, dt)
        self._face_corners, self._hinge_corners = Corners(cloth.faces), Corners(cloth.hinges)

    def energies(self, pos: Tensor, acc: Tensor) -> list[Tensor]:
        """Energies [J] (B,), term by term or several together, at ``pos`` (V, 3) reached with ``acc`` (V, 3)."""
        problem, cloth = self.problem, self.problem.cloth
        parts = [(energy, cloth.vertex_scene) for energy in self.vertices.energies(pos, acc, problem.vertex_dt)]
        parts += [(energy, points.scene) for points in self.points for energy in points.energies(pos)]
        if self.has_membrane:
            parts.append((elements.face_energy(self._face_corners(pos), self.face_constants), cloth.face_scene))
        if self.bendings:
            x = self._hinge_corners(pos)
            parts += [(elements.hinge_energy(form, x, self.hinge_constants), cloth.hinge_scene) for form in self.bendings]
        sums = [_sum(values, scene, problem.num_scenes) for values, scene in parts]
        sums += [term(problem, pos, acc) for term in self.springs] + [block.energy(pos) for block in self.blocks]
        return sums + ([] if self.others is None else list(self.others.energies(problem, pos, acc).values()))

    def vertex_model(self, pos: Tensor, acc: Tensor) -> VertexModel:
        """Derivatives of what acts on single vertices, and of what is bounded there, at ``pos`` (V, 3) reached with ``acc``."""
        model = self.vertices.model(pos, acc)
        for block in self.blocks:
            gradient, matrix = block.derivatives(pos)
            model = VertexModel(model.gradient + gradient, model.matrix + matrix, model.indefinite_part)
        return model

    def faces(self, pos: Tensor, out: Tensor | None = None) -> elements.FaceModel | None:
        """The membrane at ``pos`` (V, 3), its matrix in ``out``; None without such a term."""
        return elements.face_model(self._face_corners(pos), self.face_constants, out=out) if self.has_membrane else None

    def hinges(self, pos: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Gradient and row of every bending term, see :func:`hood.solver.derivatives.elements.hinge_model`."""
        if not self.bendings:
            return []
        x = self._hinge_corners(pos)
        return [elements.hinge_model(form, x, self.hinge_constants) for form in self.bendings]

    def attachments(self, pos: Tensor) -> tuple[Tensor, Tensor] | None:
        """Gradient and matrix of the springs, see :func:`hood.solver.derivatives.elements.spring_model`; None without any."""
        attachments = self.problem.step.attachments
        if attachments is None or not self.springs:
            return None
        return elements.spring_model(self.spring_stiffness(), Corners(attachments.edges)(pos), self.spring_targets)

    def spring_stiffness(self) -> Tensor:
        """Spring constants [N/m] (A,), of all terms together."""
        return torch.stack([term.closed_form(self.problem) for term in self.springs]).sum(0)

    def other_gradient(self, pos: Tensor, acc: Tensor) -> Tensor | None:
        """Gradient (V, 3) [N] of the energies that have no closed form here, by autograd; None without any."""
        if self.others is None or not is_followed():
            return None if self.others is None else self.others.gradient(self.problem, pos, acc)[0]
        at = pos if pos.requires_grad else pos.detach().requires_grad_()
        return torch.autograd.grad(self.others.total(self.problem, at).sum(), at, create_graph=True)[0]


def stretch_rate(potential: Potential, problem: StepProblem) -> Tensor | None:
    """Viscous stress of the membrane in units of the elastic one of the step's strain, (F,); None without damping."""
    active = potential.active(problem)
    time, elastic = sum(_forms(active, problem, Form.MEMBRANE_DAMPING)), len(having(active, Form.MEMBRANE))
    return time / elastic / problem.step.dt[problem.cloth.face_scene] if time and elastic else None


def _forms(active: Mapping[str, Term], problem: StepProblem, form: Form) -> list[Any]:
    return [term.closed_form(problem) for term in having(active, form).values()]


def _sum(values: Tensor, scene: Tensor, num_scenes: int) -> Tensor:
    return values.sum().reshape(1) if num_scenes == 1 else sum_per_scene(values, scene, num_scenes)


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
