"""What the solver knows about a cloth before the first step, and the assembly of gradient and Hessian on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Attachments
from hood.contact.self_contact import SceneLayers
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerGrips
from hood.solver.derivatives import elements
from hood.solver.derivatives.self_contact import LayerRows, grips_of, layer_rows, layers_of
from hood.solver.derivatives.step_terms import PointBlocks, StepTerms, point_blocks
from hood.solver.system.sparsity import BlockPattern, Scatter, axial_targets, matrix_targets, to_vertices, upper_pairs
from hood.tensors.batch import made_of


class SolverPlan:
    """Unknowns, sparsity and scatter maps of a cloth; valid for every step with the same attachments' edges.

    Unknowns are the N free vertices, in the order of their indices. What takes time and memory is made when it is first asked
    for: the compiled solver has tables of its own.

    Args:
        attachments: of the steps, when they have any: their edges enter the sparsity.
    """

    def __init__(self, cloth: Cloth, attachments: Attachments | None = None) -> None:
        free = cloth.free.cpu().numpy()
        self.unknown = np.where(free, np.cumsum(free) - 1, -1)  # (V,) numbers of the free vertices, -1 for the others
        tables = [cloth.faces, cloth.hinges] + ([] if attachments is None else [attachments.edges])
        self._corners = [table.cpu().numpy().copy() for table in tables]  # the cloth is not kept alive
        self.vertices = torch.as_tensor(np.flatnonzero(free), device=cloth.faces.device)  # (N,) indices of the free vertices
        self.scene = cloth.vertex_scene[self.vertices]  # (N,)
        self.cache: dict[str, object] = {}  # what solvers and sweeps derive from the plan

    @cached_property
    def pattern(self) -> BlockPattern:
        couples = np.concatenate([_pairs(table) for table in self._unknowns])
        return BlockPattern(len(self.vertices), couples[(couples >= 0).all(axis=1)])

    @cached_property
    def matrix(self) -> Scatter:
        """Matrices of all vertices, faces, hinges and attachments, one after the other, onto the pattern."""
        return _matrix_sum(self.pattern, self.unknown, self._unknowns)

    @cached_property
    def indefinite_part(self) -> Scatter:
        """Slack of vertices and faces onto the pattern."""
        return _slack_sum(self.pattern, self.unknown, self._unknowns[0])

    @cached_property
    def face_vertices(self) -> Scatter:
        """Gradients of faces onto all V vertices."""
        return to_vertices(self._corners[0], len(self.unknown))

    @cached_property
    def hinge_vertices(self) -> Scatter:
        return to_vertices(self._corners[1], len(self.unknown))

    @cached_property
    def attachment_vertices(self) -> Scatter:
        return to_vertices(self._corners[2], len(self.unknown))

    @cached_property
    def centroids(self) -> PointBlocks:
        """Blocks of points in the middle of every face."""
        thirds = torch.full((len(self._corners[0]), 3), 1.0 / 3.0, dtype=torch.float64, device=self.vertices.device)
        return point_blocks(self.pattern, self._corners[0], thirds, self.unknown)

    @property
    def _unknowns(self) -> list[np.ndarray]:
        return [self.unknown[table] for table in self._corners]


@dataclass(frozen=True)
class QuadraticModel:
    """Second-order model of the potential about a state."""

    gradient: Tensor  # (V, 3) N, pinned and massless vertices included
    triples: Tensor  # (R, 3) N/m, positive definite matrix of the free vertices in the pattern's layout
    indefinite_part: Tensor  # (R, 3) N/m, what is missing to the Hessian; negative semi-definite
    layers: LayerRows | None = None  # what cloth near cloth adds; None where there is none


def plan_for(problem: StepProblem) -> SolverPlan:
    """The plan of the problem's cloth, kept as long as the cloth's faces live and nothing it depends on changes."""
    cloth, attachments = problem.cloth, problem.step.attachments
    now, made = (cloth.hinges, cloth.free, None if attachments is None else attachments.edges), made_of(cloth.faces)
    then, plan = made.get("plan", (None, None))
    if plan is None or not all(_same(a, b) for a, b in zip(now, then, strict=True)):
        plan = SolverPlan(cloth, attachments)
        made["plan"] = now, plan
    assert isinstance(plan, SolverPlan)
    return plan


class ModelBuilder:
    """Assembles the quadratic models of one step; keeps the memory that every model needs."""

    def __init__(
        self,
        terms: StepTerms,
        plan: SolverPlan,
        layers: tuple[SceneLayers, ...] = (),
        grips: LayerGrips | None = None,
    ) -> None:
        self.terms, self.plan, self._layers, self._grips = terms, plan, layers, grips
        cloth, like = terms.problem.cloth, terms.problem.state.pos
        sizes = [9 * len(like), 45 * len(cloth.faces), 78 * len(cloth.hinges)]
        # Zero where nothing is ever written: no such term.
        self._values, self._slack = like.new_zeros(plan.matrix.num_values), like.new_zeros(plan.indefinite_part.num_values)
        parts = self._values.split([*sizes, len(self._values) - sum(sizes)])
        self._vertices, self._faces, self._hinges, self._springs = parts
        self._vertex_slack, self._face_slack = self._slack.split([sizes[0], len(self._slack) - sizes[0]])
        self._blocks = [
            plan.centroids
            if points.centroids
            else point_blocks(plan.pattern, points.vertices.cpu().numpy(), points.weights, plan.unknown)
            for points in terms.points
        ]

    def __call__(self, pos: Tensor, acc: Tensor) -> QuadraticModel:
        """The model at ``pos`` (V, 3) reached with ``acc`` (V, 3)."""
        assemble = self._at_once if self.plan.matrix.by_index_alone(pos) else self._in_parts
        return self._with_points(*assemble(pos, acc), pos, acc)

    def _in_parts(self, pos: Tensor, acc: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gradient of single vertices and elements, and the entries of their matrices; in the memory of this object."""
        terms, plan = self.terms, self.plan
        vertices = terms.vertex_model(pos, acc)
        gradient = vertices.gradient
        self._vertices.copy_(vertices.matrix.reshape(-1))
        if vertices.indefinite_part is not None:
            self._vertex_slack.copy_(vertices.indefinite_part.reshape(-1))
        faces = terms.faces(pos, out=self._faces.view(45, -1))
        if faces is not None:
            gradient = gradient + plan.face_vertices(faces.gradient).view(-1, 3)
            self._face_slack.copy_(faces.indefinite_part.view(-1))
        for index, (slope, row) in enumerate(terms.hinges(pos)):
            gradient = gradient + plan.hinge_vertices(slope).view(-1, 3)
            elements.outer_upper(row.flatten(0, 1), self._hinges.view(78, -1), add=index > 0)
        springs = terms.attachments(pos)
        if springs is not None:
            gradient = gradient + plan.attachment_vertices(springs[0]).view(-1, 3)
            self._springs.copy_(springs[1].view(-1))
        return gradient, self._values, self._slack

    def _at_once(self, pos: Tensor, acc: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same without writing to a part of anything."""
        terms, plan = self.terms, self.plan
        vertices = terms.vertex_model(pos, acc)
        gradient, slack = vertices.gradient, vertices.indefinite_part
        values = [vertices.matrix, self._faces, self._hinges, self._springs]
        slacks = [self._vertex_slack if slack is None else slack, self._face_slack]
        faces = terms.faces(pos)
        if faces is not None:
            gradient = gradient + plan.face_vertices(faces.gradient).view(-1, 3)
            values[1], slacks[1] = faces.matrix, faces.indefinite_part
        for index, (slope, row) in enumerate(terms.hinges(pos)):
            gradient = gradient + plan.hinge_vertices(slope).view(-1, 3)
            products = elements.upper_of_products(row.flatten(0, 1))
            values[2] = products if index == 0 else values[2] + products
        springs = terms.attachments(pos)
        if springs is not None:
            gradient = gradient + plan.attachment_vertices(springs[0]).view(-1, 3)
            values[3] = springs[1]
        return gradient, torch.cat([one.reshape(-1) for one in values]), torch.cat([one.reshape(-1) for one in slacks])

    def _with_points(self, gradient: Tensor, values: Tensor, slack: Tensor, pos: Tensor, acc: Tensor) -> QuadraticModel:
        """The model, with points inside faces and what other terms add."""
        terms, plan = self.terms, self.plan
        other = terms.other_gradient(pos, acc)
        gradient = gradient if other is None else gradient + other
        triples, indefinite_part = plan.matrix(values).view(-1, 3), plan.indefinite_part(slack).view(-1, 3)
        for points, blocks in zip(terms.points, self._blocks, strict=True):
            model = points.model(pos)
            gradient = gradient + points.spread(model.gradient, gradient)
            triples = blocks.add(triples, model.matrix)
            indefinite_part = (
                indefinite_part if model.indefinite_part is None else blocks.add(indefinite_part, model.indefinite_part)
            )
        near = layer_rows(self._layers, self._grips, pos, plan.unknown) if self._layers else None
        if near is not None:
            triples = triples.index_add(0, plan.pattern.diagonal.to(triples.device).reshape(-1), near.own.reshape(-1, 3))
        return QuadraticModel(gradient, triples, indefinite_part, near)


def quadratic_model(potential: Potential, problem: StepProblem, plan: SolverPlan, pos: Tensor, acc: Tensor) -> QuadraticModel:
    """Gradient of the potential, equal to :meth:`Potential.gradient`, a positive definite matrix and what it lacks.

    Matrix plus indefinite part is the Hessian, exact for inertia, contact, friction and membrane, Gauss-Newton for bending (see
    :mod:`hood.solver.derivatives.elements`). Terms of other classes enter the gradient, by autograd, but not the matrix.
    """
    layers, grips = layers_of(potential, problem), grips_of(potential, problem)
    return ModelBuilder(StepTerms(potential, problem), plan, layers, grips)(pos, acc)


def _matrix_sum(pattern: BlockPattern, unknown: np.ndarray, elements: list[np.ndarray]) -> Scatter:
    targets, sources, num_values = [_block_targets(pattern, unknown)], [np.arange(9 * len(unknown))], 9 * len(unknown)
    for table in elements:
        target, source = matrix_targets(pattern, table)
        targets.append(target)
        sources.append(num_values + source)
        num_values += len(upper_pairs(3 * table.shape[1])) * len(table)
    return Scatter(np.concatenate(targets), np.concatenate(sources), 3 * pattern.num_triples, num_values)


def _slack_sum(pattern: BlockPattern, unknown: np.ndarray, faces: np.ndarray) -> Scatter:
    target, source = axial_targets(pattern, faces)
    targets, num_values = np.concatenate([_block_targets(pattern, unknown), target]), 9 * len(unknown)
    sources = np.concatenate([np.arange(num_values), num_values + source])
    return Scatter(targets, sources, 3 * pattern.num_triples, num_values + len(upper_pairs(faces.shape[1])) * len(faces))


def _block_targets(pattern: BlockPattern, unknown: np.ndarray) -> np.ndarray:
    """Where matrices (V, 3, 3) of single vertices go; -1 for fixed ones."""
    triple = pattern.triples(unknown, unknown)[:, :, None]
    return np.where(triple >= 0, 3 * triple + np.arange(3), -1).reshape(-1)


def _pairs(corners: np.ndarray) -> np.ndarray:
    """(K, 2) unordered pairs of different corners of elements (N, C)."""
    first, second = np.triu_indices(corners.shape[1], 1)
    return np.stack([corners[:, first], corners[:, second]], axis=2).reshape(-1, 2)


def _same(a: Tensor | None, b: Tensor | None) -> bool:
    return a is b or (a is not None and b is not None and a.shape == b.shape and bool((a == b).all()))
