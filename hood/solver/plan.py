"""What the solver knows about a cloth before the first step, and the assembly of gradient and Hessian on it."""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from hood.losses.attachment import Attachment
from hood.losses.bending import Bending
from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.losses.stretching import Stretching
from hood.scene.cloth import Cloth
from hood.scene.state import Attachments
from hood.solver import elements
from hood.solver.pattern import BlockPattern, RowSum


@dataclass(frozen=True)
class SolverPlan:
    """Unknowns, sparsity and scatter maps of a cloth; valid for every step with the same attachments' edges.

    Unknowns are the N free vertices, in the order of their indices.
    """

    vertices: Tensor  # (N,) indices of the free vertices
    scene: Tensor  # (N,) their scenes
    pattern: BlockPattern
    vertex_triples: RowSum  # from all V vertices; fixed ones are left out
    face_triples: RowSum
    hinge_triples: RowSum
    attachment_triples: RowSum | None
    face_vertices: RowSum  # onto all V vertices
    hinge_vertices: RowSum
    cache: dict[str, object] = field(default_factory=dict)  # what linear solvers and sweeps derive from the above


@dataclass(frozen=True)
class QuadraticModel:
    """Second-order model of the potential about a state."""

    gradient: Tensor  # (V, 3) N, pinned and massless vertices included
    triples: Tensor  # (R, 3) N/m, the Hessian of the free vertices in the pattern's layout


def build_plan(cloth: Cloth, attachments: Attachments | None = None) -> SolverPlan:
    """Plan for steps of ``cloth``; ``attachments`` when the steps have any (their edges enter the sparsity)."""
    free = cloth.free.cpu().numpy()
    unknown = np.where(free, np.cumsum(free) - 1, -1)
    faces, hinges = (unknown[table.cpu().numpy()] for table in (cloth.faces, cloth.hinges))
    pairs = [_pairs(faces), _pairs(hinges)]
    edges = None
    if attachments is not None:
        edges = unknown[attachments.edges.cpu().numpy()]
        pairs.append(_pairs(edges))
    couples = np.concatenate(pairs)
    pattern = BlockPattern(int(free.sum()), couples[(couples >= 0).all(axis=1)])
    num_vertices = cloth.num_vertices
    vertices = torch.as_tensor(np.flatnonzero(free), device=cloth.faces.device)
    return SolverPlan(
        vertices=vertices,
        scene=cloth.vertex_scene[vertices],
        pattern=pattern,
        vertex_triples=RowSum(pattern.triples(unknown, unknown), pattern.num_triples),
        face_triples=_triple_sum(pattern, faces),
        hinge_triples=_triple_sum(pattern, hinges),
        attachment_triples=None if edges is None else _triple_sum(pattern, edges),
        face_vertices=RowSum(cloth.faces.cpu().numpy(), num_vertices),
        hinge_vertices=RowSum(cloth.hinges.cpu().numpy(), num_vertices),
    )


_PLANS: dict[int, tuple[weakref.ref[Tensor], tuple[Tensor, Tensor, Tensor | None], SolverPlan]] = {}


def plan_for(problem: StepProblem) -> SolverPlan:
    """The plan of the problem's cloth, kept as long as the cloth's faces live and nothing it depends on changes."""
    cloth, attachments = problem.cloth, problem.step.attachments
    now = (cloth.hinges, cloth.free, None if attachments is None else attachments.edges)
    key = id(cloth.faces)
    if key in _PLANS:
        reference, then, plan = _PLANS[key]
        if reference() is cloth.faces and all(_same(a, b) for a, b in zip(now, then, strict=True)):
            return plan
    plan = build_plan(cloth, attachments)
    _PLANS[key] = (weakref.ref(cloth.faces, lambda _: _PLANS.pop(key, None)), now, plan)
    return plan


def quadratic_model(potential: Potential, problem: StepProblem, plan: SolverPlan, pos: Tensor, acc: Tensor) -> QuadraticModel:
    """Gradient of the potential, equal to :meth:`Potential.gradient`, and a positive definite Hessian.

    The Hessian is exact for inertia, contact and friction, projected for the membrane, Gauss-Newton for bending (see
    :mod:`hood.solver.elements`). Terms of other classes enter the gradient, by autograd, but not the Hessian.
    """
    gradient, blocks = elements.vertex_model(potential, problem, pos, acc)
    other = elements.other_gradient(potential, problem, pos, acc)
    gradient = gradient if other is None else gradient + other
    cloth = problem.cloth
    triples = plan.vertex_triples(blocks.reshape(-1, 3))
    terms = [term for term in potential.terms.values() if term.applies(problem)]
    for term in terms:
        if type(term) is Stretching:
            face = elements.face_model(
                pos[cloth.faces],
                elements.face_shape(cloth.rest_inverse),
                cloth.rest_area * cloth.thickness,
                cloth.lame_mu,
                cloth.lame_lambda,
            )
            gradient = gradient + plan.face_vertices(face.gradient.reshape(-1, 3))
            triples += plan.face_triples(_face_matrix(face).reshape(-1, 3))
        elif type(term) is Bending:
            slope, root = elements.hinge_model(pos[cloth.hinges], cloth.rest_angle, elements.hinge_weight(problem))
            gradient = gradient + plan.hinge_vertices(slope.reshape(-1, 3))
            row = root.reshape(-1, 12)
            triples += plan.hinge_triples((row[:, :, None] * row[:, None, :]).reshape(-1, 3))
        elif type(term) is Attachment:
            assert plan.attachment_triples is not None
            force, matrix = _attachments(term, problem, pos)
            gradient = gradient + force
            triples += plan.attachment_triples(matrix.reshape(-1, 3))
    return QuadraticModel(gradient, triples)


def _face_matrix(face: elements.FaceModel) -> Tensor:
    """(F, 9, 9) with rows and columns ordered by corner, then axis."""
    root = face.root.reshape(-1, 3, 9)
    matrix = root[:, 0, :, None] * root[:, 0, None, :]
    for row in (1, 2):  # faster than a batched product of matrices this small
        matrix.addcmul_(root[:, row, :, None], root[:, row, None, :])
    by_axis = matrix.view(-1, 3, 3, 3, 3)
    for axis in range(3):
        by_axis[:, :, axis, :, axis] += face.axial
    return matrix


def _attachments(term: Attachment, problem: StepProblem, pos: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (V, 3) and element matrices (A, 6, 6) of the springs."""
    attachments = problem.step.attachments
    assert attachments is not None
    stiffness = elements.attachment_stiffness(term, problem)
    a, b = attachments.edges.unbind(dim=1)
    pull = stiffness[:, None] * (pos[a] - pos[b])
    gradient = torch.zeros_like(pos).index_add(0, a, pull).index_add(0, b, -pull)
    sign = torch.tensor([[1.0, -1.0], [-1.0, 1.0]], dtype=pos.dtype, device=pos.device)
    unit = torch.kron(sign, torch.eye(3, dtype=pos.dtype, device=pos.device))
    return gradient, stiffness[:, None, None] * unit


def _pairs(corners: np.ndarray) -> np.ndarray:
    """(K, 2) unordered pairs of different corners of elements (N, C)."""
    first, second = np.triu_indices(corners.shape[1], 1)
    return np.stack([corners[:, first], corners[:, second]], axis=2).reshape(-1, 2)


def _triple_sum(pattern: BlockPattern, corners: np.ndarray) -> RowSum:
    """Where the triples of element matrices (N, 3C, 3C) go; they are ordered by row corner, axis, column corner."""
    count, width = corners.shape
    rows = np.broadcast_to(corners[:, :, None], (count, width, width))
    cols = np.broadcast_to(corners[:, None, :], (count, width, width))
    return RowSum(pattern.triples(rows, cols).transpose(0, 1, 3, 2), pattern.num_triples)


def _same(a: Tensor | None, b: Tensor | None) -> bool:
    return a is b or (a is not None and b is not None and a.shape == b.shape and bool((a == b).all()))
