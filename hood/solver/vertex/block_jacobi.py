"""The potential as every vertex sees it alone: its force, and the step it would take with its neighbours held.

The step that all vertices would take together: conjugate gradients on the positive matrix of the potential. A local step passes
an error on by one edge; long waves, in which every vertex moves with its neighbours, it hardly sees. The global step solves for
all vertices at once; its reach in edges is the number of steps of conjugate gradients, which grows with the mesh. The matrix is
never put together: elements are multiplied one by one, in shapes that do not depend on values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from hood.cloth.cloth import Cloth
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.term import MATRIX_FORMS, Form, form_of, having
from hood.solver.derivatives.elements import FaceModel
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.system.linear import invert_blocks
from hood.tensors.batch import made_of
from hood.tensors.conjugate_gradients import Scenes, Steps, solve
from hood.tensors.dense import add_rows, unfollowed

#: Half as many as there are vertices along a square sheet: from its middle to its rim.
STEPS = Steps(0.5, 8)
#: Upper triangle of a 3 × 3 block.
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True)
class LocalView:
    """Force and local step of every vertex at one set of positions; zero where nothing moves."""

    force: Tensor  # (V, 3) N, −∂Φ/∂x
    step: Tensor  # (V, 3) m, D⁻¹ force with the positive diagonal block D of the Hessian


class LocalTerms:
    """Views of one step's potential; everything constant in the step is gathered once."""

    _looked_at: tuple[Tensor, PositiveMatrix, Tensor] | None = None  # positions, the matrix there and its diagonal blocks

    def __init__(self, potential: Potential, problem: StepProblem) -> None:
        self.problem = problem
        self.terms = StepTerms(potential, problem)
        self._incidence = incidence_of(problem.cloth)

    @unfollowed
    def __call__(self, pos: Tensor) -> LocalView:
        """The view at positions (V, 3)."""
        terms, cloth = self.terms, self.problem.cloth
        acc = self.problem.acceleration(pos)
        own = terms.vertex_model(pos, acc)
        gradient, matrix = own.gradient, own.matrix
        faces, hinges = terms.faces(pos), terms.hinges(pos)
        if faces is not None or hinges:
            order, offsets = self._incidence
            table = torch.cat([_of_faces(faces, cloth, pos), _of_hinges(hinges, cloth, pos)], dim=1).t().contiguous()
            sums = functional.embedding_bag(order, table, offsets, mode="sum", include_last_offset=True)
            gradient = gradient + sums[:, :3]
            a, b, c, d, e, f = sums[:, 3:].unbind(dim=1)
            matrix = matrix + torch.stack([a, b, c, b, d, e, c, e, f], dim=1).view(-1, 3, 3)
        springs = terms.attachments(pos)
        if springs is not None:
            ends = self.problem.step.attachments.edges.t().reshape(-1)  # type: ignore[union-attr]
            gradient = add_rows(gradient, ends, springs[0].permute(0, 2, 1).reshape(-1, 3))
            stiffness = terms.spring_stiffness().repeat(2)
            matrix = add_rows(matrix, ends, stiffness[:, None, None] * torch.eye(3, dtype=matrix.dtype, device=matrix.device))
        models = [points.model(pos) for points in terms.points]
        for points, model in zip(terms.points, models, strict=True):
            gradient = gradient + points.spread(model.gradient, gradient)
            matrix = matrix + points.spread_blocks(model.matrix, len(gradient))
        other = terms.other_gradient(pos, acc)
        gradient = gradient if other is None else gradient + other
        force = torch.where(cloth.free.unsqueeze(1), -gradient, 0.0)
        step = torch.bmm(invert_blocks(matrix), force.unsqueeze(2)).squeeze(2)
        whole = PositiveMatrix(own.matrix, faces, tuple(row for _, row in hinges), tuple(model.matrix for model in models))
        self._looked_at = pos, whole, matrix
        return LocalView(force, torch.where(cloth.free.unsqueeze(1), step, 0.0))

    @unfollowed
    def solve(self, pos: Tensor, force: Tensor, damping: Tensor, steps: Steps = STEPS) -> Tensor:
        """The global step (V, 3) [m] under forces (V, 3) [N]: u with (A + diag(``damping``)) u = ``force`` where vertices are
        free, 0 elsewhere, as nearly as ``steps`` of conjugate gradients come. A is the positive matrix at positions (V, 3),
        ``damping`` (V,) [N/m]."""
        if self._looked_at is None or self._looked_at[0] is not pos:
            self(pos)
        assert self._looked_at is not None
        return global_step(self.terms, *self._looked_at[1:], self._incidence, force, damping, steps)


def check_local(potential: Potential) -> None:
    """Raise ValueError where local steps of ``potential`` are not known: they take second derivatives of every term, and a
    positive one of every vertex, which inertia alone is sure to have."""
    for name, term in potential.terms.items():
        if form_of(term) not in MATRIX_FORMS:
            raise ValueError(
                f"losses.terms.{name} is a {type(term).__name__}: its second derivatives are not written out "
                f"(hood/solver/derivatives/vertices.py, elements.py), and what single vertices would do about it is not known"
            )
    if not having(potential.terms, Form.MASS):
        raise ValueError("losses.terms: no inertia, without which what single vertices would do is not determined")


def _of_faces(faces: FaceModel | None, cloth: Cloth, pos: Tensor) -> Tensor:
    """(9, 3F) gradient and diagonal block of the corners; zeros without a membrane, which has its place all the same."""
    if faces is None:
        return pos.new_zeros(9, cloth.faces.numel())
    return torch.cat([faces.gradient.transpose(0, 1), _diagonal(faces.matrix)]).flatten(1)


def _of_hinges(hinges: Sequence[tuple[Tensor, Tensor]], cloth: Cloth, pos: Tensor) -> Tensor:
    """(9, 4H) the same of all bending terms together."""
    parts = [
        torch.cat([slope.transpose(0, 1), torch.stack([row[:, a] * row[:, b] for a, b in _PAIRS])]) for slope, row in hinges
    ]
    return sum(parts[1:], start=parts[0]).flatten(1) if parts else pos.new_zeros(9, cloth.hinges.numel())


def _diagonal(upper: Tensor) -> Tensor:
    """(6, 3, N) diagonal blocks of element matrices given by their upper triangles (45, N)."""
    return torch.stack([torch.stack([upper[_place(3 * c + a, 3 * c + b)] for c in range(3)]) for a, b in _PAIRS])


def _place(row: int, col: int, size: int = 9) -> int:
    return row * size - row * (row - 1) // 2 + col - row


def incidence_of(cloth: Cloth) -> tuple[Tensor, Tensor]:
    """Corners of faces and hinges by the vertex they are at, kept as long as the cloth's faces live."""
    made = made_of(cloth.faces)
    if "incidence" in made:
        return made["incidence"]
    vertex = torch.cat([cloth.faces.t().reshape(-1), cloth.hinges.t().reshape(-1)])
    order = torch.argsort(vertex, stable=True)
    count = vertex.new_zeros(cloth.num_vertices).index_add(0, vertex, torch.ones_like(vertex))
    value = made["incidence"] = (order, torch.cat([count.new_zeros(1), count.cumsum(0)]))
    return value


@dataclass(frozen=True)
class PositiveMatrix:
    """Second derivatives of a potential at one set of positions, positive semi-definite element by element."""

    vertices: Tensor  # (V, 3, 3) N/m, inertia, contact and friction
    faces: FaceModel | None  # None without a membrane
    hinges: tuple[Tensor, ...]  # (4, 3, H) of every bending term: its matrix is the row times itself
    points: tuple[Tensor, ...]  # (N, 3, 3) N/m of contact inside edges and faces


def global_step(
    terms: StepTerms,
    matrix: PositiveMatrix,
    blocks: Tensor,
    incidence: tuple[Tensor, Tensor],
    force: Tensor,
    damping: Tensor,
    steps: Steps = STEPS,
) -> Tensor:
    """Approximate u (V, 3) [m] with (A + diag(``damping``)) u = ``force`` (V, 3) [N] at free vertices and u = 0 at the others.

    Args:
        matrix: A.
        blocks: (V, 3, 3) N/m, its diagonal.
        incidence: corners of faces and hinges by the vertex they are at, :func:`hood.solver.vertex.block_jacobi.incidence_of`.
        damping: (V,) N/m, at least 0.
    """
    cloth = terms.problem.cloth
    free = cloth.free.unsqueeze(1)
    more = torch.diag_embed(damping.unsqueeze(1).expand(-1, 3))
    inverse, product = invert_blocks(blocks + more), _product(terms, matrix, incidence)

    def apply(x: Tensor) -> Tensor:
        return torch.where(free, product(x) + damping.unsqueeze(1) * x, 0.0)

    def precondition(r: Tensor) -> Tensor:
        return torch.where(free, torch.bmm(inverse, r.unsqueeze(2)).squeeze(2), 0.0)

    scenes = Scenes(cloth.vertex_scene, cloth.scene_sizes)
    return solve(apply, precondition, torch.where(free, force, 0.0), scenes, steps)


def _product(terms: StepTerms, matrix: PositiveMatrix, incidence: tuple[Tensor, Tensor]) -> Callable[[Tensor], Tensor]:
    """x (V, 3) → A x (V, 3)."""
    cloth, (order, offsets) = terms.problem.cloth, incidence
    faces = None if matrix.faces is None else _full(matrix.faces.matrix)
    rows = [row.permute(2, 0, 1).reshape(-1, 12) for row in matrix.hinges]
    springs = _springs(terms)

    def product(x: Tensor) -> Tensor:
        around, about = x[cloth.faces].view(-1, 9, 1), x[cloth.hinges].view(-1, 12)
        pulled = torch.zeros_like(around) if faces is None else torch.bmm(faces, around)
        turned = sum((row * (row * about).sum(dim=1, keepdim=True) for row in rows), torch.zeros_like(about))
        corners = [part.view(len(part), -1, 3).transpose(0, 1).reshape(-1, 3) for part in (pulled, turned)]
        result = functional.embedding_bag(order, torch.cat(corners), offsets, mode="sum", include_last_offset=True)
        result = result + torch.bmm(matrix.vertices, x.unsqueeze(2)).squeeze(2)
        for points, block in zip(terms.points, matrix.points, strict=True):
            result = result + points.spread(torch.bmm(block, points.at(x).unsqueeze(2)).squeeze(2), x)
        return result if springs is None else springs(result, x)

    return product


def _springs(terms: StepTerms) -> Callable[[Tensor, Tensor], Tensor] | None:
    """Adds the springs' share of A x (V, 3) to it; None without any."""
    attachments = terms.problem.step.attachments
    if attachments is None or not terms.springs:
        return None
    start, end = attachments.edges.unbind(dim=1)
    stiffness = terms.spring_stiffness().unsqueeze(1)

    def add(product: Tensor, x: Tensor) -> Tensor:
        pull = stiffness * (x[start] - x[end])
        return add_rows(add_rows(product, start, pull), end, -pull)

    return add


def _full(upper: Tensor) -> Tensor:
    """(N, 9, 9) element matrices given by their upper triangles (45, N)."""
    first = [9 * row - row * (row - 1) // 2 - row for row in range(9)]  # of its row, less its column
    return torch.stack([upper[first[min(a, b)] + max(a, b)] for a in range(9) for b in range(9)], dim=1).view(-1, 9, 9)
