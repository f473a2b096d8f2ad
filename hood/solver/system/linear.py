"""Linear systems with the Hessian: preconditioned conjugate gradients, and a direct band factorisation.

Newton directions: as much of the Hessian's negative curvature as the linear system bears.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg
from torch import Tensor

from hood.energies.problem import sum_per_scene
from hood.solver.derivatives.self_contact import LayerRows
from hood.solver.system.plan import QuadraticModel, SolverPlan
from hood.solver.system.sparsity import BlockPattern, row_product
from hood.tensors.dense import at_once, sum_rows

#: Linear systems are solved to the root of the relative gradient, at least and at most to these.
TOLERANCES = 1e-3, 0.1
#: Below this share of the indefinite part the next try does without.
LEAST_SHARPNESS = 0.2
#: The first share that is tried.
FIRST_SHARPNESS = 0.1


class Directions:
    """Solves the Newton systems of a minimisation, scene by scene.

    The positive matrix of :class:`hood.solver.system.plan.QuadraticModel` is larger than the Hessian under compression and
    along sliding contacts: with it alone the last digits come linearly, by a factor of about 2 an iteration. So a share of the
    indefinite part is added, the *indefinite share*: none at first, where the model is farthest from the energy, then a tenth,
    twice as much with every system solved, half as much wherever the linear solver meets negative curvature, none below 0.2.
    Over 96 steps of worn garments of 1,000 and 4,400 vertices this needs 4 and 4.5 iterations to γ = 0.01 in the median; to
    begin with all of the indefinite part took 5 and 6. The idea to convexify only where that turns out necessary is that of
    Fernández-Fernández et al. ("Progressively Projected Newton's Method", 2025), who decide element by element.
    """

    def __init__(self, plan: SolverPlan, num_scenes: int, linear: str, cg_iterations: int) -> None:
        self.plan, self.num_scenes = plan, num_scenes
        self.linear, self.cg_iterations = linear, cg_iterations
        self.used = 0  # conjugate gradient iterations so far
        self._sharpness: Tensor | None = None

    def __call__(self, model: QuadraticModel, residual: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
        """Direction (V, 3), zero where nothing moves, and the inverse diagonal blocks (N, 3, 3) of the positive matrix.

        Args:
            residual: (B,) relative gradient, from which the accuracy follows.
            active: (B,) bool, scenes to move.
        """
        plan = self.plan
        indefinite_share = torch.zeros_like(residual) if self._sharpness is None else self._sharpness
        moving = active[plan.scene].unsqueeze(1)
        rhs = torch.where(moving, -model.gradient[plan.vertices], 0.0)
        inverse = diagonal_inverse(plan.pattern, self._idle(model.triples, active))
        solution, pending, halved = torch.zeros_like(rhs), active, torch.zeros_like(active)
        while True:
            triples = self._idle(self._sharpened(model, indefinite_share), pending)
            right = torch.where(pending[plan.scene].unsqueeze(1), rhs, 0.0)
            found, failed = self._solve(triples, inverse, right, residual, model.layers)
            failed = failed & pending & (indefinite_share > 0)
            solution = torch.where((pending & ~failed)[plan.scene].unsqueeze(1), found, solution)
            if not bool(failed.any()):
                break
            pending, halved = failed, halved | failed
            smaller = torch.where(indefinite_share > LEAST_SHARPNESS, 0.5 * indefinite_share, 0.0)
            indefinite_share = torch.where(failed, smaller, indefinite_share)
        raised = (2.0 * indefinite_share).clamp(FIRST_SHARPNESS, 1.0)
        self._sharpness = torch.where(halved, indefinite_share, raised)
        direction = torch.zeros_like(model.gradient)
        direction[plan.vertices] = torch.where(moving, solution, 0.0)
        return direction, inverse

    def _solve(
        self, triples: Tensor, inverse: Tensor, rhs: Tensor, residual: Tensor, layers: LayerRows | None
    ) -> tuple[Tensor, Tensor]:
        """Solution (N, 3), and the scenes (B,) bool in which the matrix is not positive definite as far as was seen."""
        if self.linear == "direct" and layers is None:  # a factorisation knows the pattern alone
            return self._solve_direct(triples, inverse, rhs)
        solution, used, failed = conjugate_gradients(
            beside(product(self.plan.pattern, triples), layers),
            by_blocks(inverse),
            rhs,
            self.plan.scene,
            self.num_scenes,
            residual.nan_to_num(0.0).sqrt().clamp(*TOLERANCES),
            self.cg_iterations,
        )
        self.used += used
        return solution, failed

    def _solve_direct(self, triples: Tensor, inverse: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
        failed = torch.zeros(self.num_scenes, dtype=torch.bool, device=rhs.device)
        while True:
            solution, row = solve_direct(self.plan, triples, rhs)
            if row is None:
                break
            failed[self.plan.scene[row]] = True
            triples = self._idle(triples, ~failed)
        # A descent direction where not even the positive matrix is one to rounding: stiffness ratios beyond the type.
        return torch.where(failed[self.plan.scene].unsqueeze(1), by_blocks(inverse)(rhs), solution), failed

    def _sharpened(self, model: QuadraticModel, indefinite_share: Tensor) -> Tensor:
        if self.num_scenes == 1:
            share = float(indefinite_share)
            return torch.add(model.triples, model.indefinite_part, alpha=share) if share > 0 else model.triples
        return torch.addcmul(model.triples, model.indefinite_part, indefinite_share[self._triple_scene()].unsqueeze(1))

    def _triple_scene(self) -> Tensor:
        return self.plan.scene[torch.as_tensor(self.plan.pattern.triple_rows // 3, device=self.plan.scene.device)]

    def _idle(self, triples: Tensor, active: Tensor) -> Tensor:
        """Identity blocks for scenes that do not move: theirs may not be finite and would spoil the others' solution."""
        if bool(active.all()):
            return triples
        plan = self.plan
        kept = torch.where(active[self._triple_scene()].unsqueeze(1), triples, 0.0)
        idle = ~active[plan.scene]
        diagonal = plan.pattern.diagonal.to(triples.device)[idle]
        kept[diagonal.reshape(-1)] = torch.eye(3, dtype=kept.dtype, device=kept.device).repeat(int(idle.sum()), 1)
        return kept


def beside(apply: Callable[[Tensor], Tensor], layers: LayerRows | None) -> Callable[[Tensor], Tensor]:
    """``apply`` with what layers add beside the pattern."""
    return apply if layers is None else lambda x: apply(x) + layers.couple(x)


@dataclass(frozen=True)
class BandLayout:
    """Places of the scalar entries in LAPACK's lower band storage under a bandwidth-reducing numbering."""

    order: np.ndarray  # (3N,) scalar unknown of every row of the band matrix
    entries: np.ndarray  # scalar entries of the pattern that lie on or below the diagonal
    places: np.ndarray  # where they go in the flat storage, column by column
    num_below: int  # diagonals below the main one


def product(pattern: BlockPattern, triples: Tensor) -> Callable[[Tensor], Tensor]:
    """x (N, 3) → H x (N, 3)."""
    if at_once(triples):
        return block_product(pattern, triples)
    apply = row_product(triples.reshape(-1), pattern.indices, pattern.indptr, 3 * pattern.size)
    return lambda x: apply(x.reshape(-1)).view(-1, 3)


def block_product(pattern: BlockPattern, triples: Tensor) -> Callable[[Tensor], Tensor]:
    """The same in torch operations, on any device."""
    cols, starts = (torch.as_tensor(table, device=triples.device) for table in (pattern.indices, pattern.indptr))
    return lambda x: sum_rows(x.reshape(-1, 1), cols, starts, triples.reshape(-1)).view(-1, 3)


def conjugate_gradients(
    apply: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    rhs: Tensor,
    scene: Tensor,
    num_scenes: int,
    tolerance: Tensor,
    max_iterations: int,
) -> tuple[Tensor, int, Tensor]:
    """Approximate solutions of H x = ``rhs`` (N, 3) scene by scene, the iterations used, and the scenes (B,) bool in
    which H turned out indefinite.

    The scenes of a batch run side by side without touching each other: each has its own step lengths and stops on its
    own, so a batch gives what its members give alone. Any truncation is a descent direction; a scene stops where a
    direction has no positive curvature.

    Args:
        apply: x → H x.
        precondition: r → P r, symmetric positive definite.
        tolerance: (B,) residual, relative to the right-hand side, both measured by the preconditioner.
    """
    if num_scenes == 1:
        x, iterations, stopped = _one_scene(apply, precondition, rhs, float(tolerance), max_iterations)
        return x, iterations, torch.tensor([stopped], device=rhs.device)

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return sum_per_scene((a * b).sum(1), scene, num_scenes)

    x, r = torch.zeros_like(rhs), rhs.clone()
    z = precondition(r)
    p, rz = z, dot(r, z)
    limit = tolerance**2 * rz
    active, indefinite = rz > limit, torch.zeros_like(rz, dtype=torch.bool)
    for iteration in range(max_iterations):
        if not bool(active.any()):
            return x, iteration, indefinite
        q = apply(p)
        curvature = dot(p, q)
        indefinite = indefinite | (active & ~(curvature > 0))
        active = active & (curvature > 0)
        length = torch.where(active, rz / torch.where(active, curvature, 1.0), 0.0)[scene].unsqueeze(1)
        # Not a product alone: a direction may have overflowed in a scene that has stopped.
        x = torch.where(length > 0, x + length * p, x)
        r = torch.where(length > 0, r - length * q, r)
        z = precondition(r)
        before, rz = rz, torch.where(active, dot(r, z), rz)
        active = active & (rz > limit)
        p = torch.where(active[scene].unsqueeze(1), z + (rz / torch.where(active, before, 1.0))[scene].unsqueeze(1) * p, 0.0)
    return x, max_iterations, indefinite


def _one_scene(
    apply: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    rhs: Tensor,
    tolerance: float,
    max_iterations: int,
) -> tuple[Tensor, int, bool]:
    """The same for a single scene, in a third of the operations."""
    x, r = torch.zeros_like(rhs), rhs.clone()
    z = precondition(r)
    p, rz = z.clone(), _dot(r, z)
    limit = tolerance**2 * rz
    for iteration in range(max_iterations):
        if not rz > limit:
            return x, iteration, False
        q = apply(p)
        curvature = _dot(p, q)
        if not curvature > 0:
            return x, iteration, True
        x.add_(p, alpha=rz / curvature)
        r.sub_(q, alpha=rz / curvature)
        z = precondition(r)
        before, rz = rz, _dot(r, z)
        p.mul_(rz / before).add_(z)
    return x, max_iterations, False


def _dot(a: Tensor, b: Tensor) -> float:
    return float(torch.dot(a.view(-1), b.view(-1)))


def by_blocks(inverse: Tensor) -> Callable[[Tensor], Tensor]:
    """r (N, 3) → inverse r with ``inverse`` (N, 3, 3) of the diagonal blocks: the block-Jacobi preconditioner."""
    return lambda r: torch.bmm(inverse, r.unsqueeze(2)).squeeze(2)


def solve_direct(plan: SolverPlan, triples: Tensor, rhs: Tensor) -> tuple[Tensor, int | None]:
    """Solution of H x = ``rhs`` (N, 3) by a band Cholesky factorisation, on the CPU, and None; where H is not positive
    definite to rounding, zeros and a block row where that was seen."""
    layout = band_layout(plan)
    size = 3 * plan.pattern.size
    values, right = triples.cpu().numpy().reshape(-1), rhs.cpu().numpy().reshape(-1)
    band = np.zeros((layout.num_below + 1) * size, dtype=values.dtype)
    band[layout.places] = values[layout.entries]
    storage = band.reshape(size, layout.num_below + 1).T  # column-major, as LAPACK wants it: no copy
    factorise, solve = linalg.get_lapack_funcs(("pbtrf", "pbtrs"), (storage,))
    factor, stop = factorise(storage, lower=1, overwrite_ab=1)
    if stop > 0:
        return torch.zeros_like(rhs), int(layout.order[stop - 1]) // 3
    solution = np.empty_like(right)
    solution[layout.order] = solve(factor, right[layout.order], lower=1)[0]
    return torch.as_tensor(solution).view(-1, 3).to(rhs.device), None


def diagonal_inverse(pattern: BlockPattern, triples: Tensor) -> Tensor:
    """Inverses (N, 3, 3) of the diagonal blocks."""
    return invert_blocks(triples[pattern.diagonal.to(triples.device).reshape(-1)].view(-1, 3, 3))


def invert_blocks(blocks: Tensor) -> Tensor:
    """Inverses of symmetric positive definite (N, 3, 3) by cofactors; much faster than one LAPACK call each."""
    # Scaled to a diagonal of ones first: cofactors of unscaled blocks would underflow in float32.
    scale = blocks.diagonal(dim1=1, dim2=2).clamp_min(torch.finfo(blocks.dtype).tiny).rsqrt()
    outer = scale[:, :, None] * scale[:, None, :]
    r0, r1, r2 = (blocks * outer).unbind(dim=1)
    c0, c1, c2 = torch.linalg.cross(r1, r2), torch.linalg.cross(r2, r0), torch.linalg.cross(r0, r1)
    determinant = torch.mv(r0 * c0, r0.new_ones(3)).clamp_min(torch.finfo(blocks.dtype).eps)
    return torch.stack([c0, c1, c2], dim=2) / determinant[:, None, None] * outer


def band_layout(plan: SolverPlan) -> BandLayout:
    """Storage of the direct solver, computed on first use."""
    if "band" not in plan.cache:
        pattern, axes = plan.pattern, np.arange(3)
        rank, num_below = pattern.band_order()
        row = np.repeat(3 * rank[pattern.triple_rows // 3] + pattern.triple_rows % 3, 3)
        col = (3 * rank[pattern.triple_cols][:, None] + axes).reshape(-1)
        entries = np.flatnonzero(row >= col)
        order = np.argsort((3 * rank[:, None] + axes).reshape(-1))
        plan.cache["band"] = BandLayout(order, entries, (row - col + col * (num_below + 1))[entries], num_below)
    layout = plan.cache["band"]
    assert isinstance(layout, BandLayout)
    return layout
