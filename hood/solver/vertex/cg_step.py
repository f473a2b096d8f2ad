"""The step that all vertices would take together: conjugate gradients on the positive matrix of the potential.

A local step moves a vertex with its neighbours held and passes an error on by one edge. Long waves, in which every vertex moves
with its neighbours, it hardly sees. The global step solves for all vertices at once; its reach in edges is the number of steps
of conjugate gradients, which grows with the mesh. The matrix is never put together: elements are multiplied one by one, in
shapes that do not depend on values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from hood.solver.derivatives.elements import FaceModel
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.system.linear import invert_blocks
from hood.tensors.conjugate_gradients import Scenes, Steps, solve
from hood.tensors.dense import add_rows

#: Half as many as there are vertices along a square sheet: from its middle to its rim.
STEPS = Steps(0.5, 8)


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
