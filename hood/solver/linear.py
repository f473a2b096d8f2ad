"""Linear systems with the Hessian: preconditioned conjugate gradients, and a direct band factorisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg, sparse
from torch import Tensor

from hood.losses.problem import sum_per_scene
from hood.solver.pattern import BlockPattern
from hood.solver.plan import SolverPlan


@dataclass(frozen=True)
class BandLayout:
    """Places of the scalar entries in LAPACK's lower band storage under a bandwidth-reducing numbering."""

    order: np.ndarray  # (3N,) scalar unknown of every row of the band matrix
    entries: np.ndarray  # scalar entries of the pattern that lie on or below the diagonal
    places: np.ndarray  # where they go in the flat storage, column by column
    num_below: int  # diagonals below the main one


def product(pattern: BlockPattern, triples: Tensor) -> Callable[[Tensor], Tensor]:
    """x (N, 3) → H x (N, 3)."""
    if triples.device.type != "cpu":
        return block_product(pattern, triples)
    blocks = (triples.view(-1, 3, 3).numpy(), pattern.cols, pattern.starts)
    matrix = sparse.bsr_matrix(blocks, shape=(3 * pattern.size, 3 * pattern.size))
    return lambda x: torch.from_numpy(matrix @ x.numpy().reshape(-1)).view(-1, 3)


def block_product(pattern: BlockPattern, triples: Tensor) -> Callable[[Tensor], Tensor]:
    """The same in torch operations, on any device."""
    rows, cols = (torch.as_tensor(index, device=triples.device) for index in (pattern.rows, pattern.cols))
    blocks = triples.view(-1, 3, 3)
    return lambda x: torch.zeros_like(x).index_add(0, rows, torch.bmm(blocks, x[cols].unsqueeze(2)).squeeze(2))


def conjugate_gradients(
    apply: Callable[[Tensor], Tensor],
    inverse: Tensor,
    rhs: Tensor,
    scene: Tensor,
    num_scenes: int,
    tolerance: Tensor,
    max_iterations: int,
) -> tuple[Tensor, int]:
    """Approximate solutions of H x = ``rhs`` (N, 3), scene by scene, and the iterations used.

    The scenes of a batch run side by side without touching each other: each has its own step lengths and stops on its
    own, so a batch gives what its members give alone. Any truncation is a descent direction.

    Args:
        apply: x → H x.
        inverse: (N, 3, 3) inverses of the diagonal blocks, the preconditioner.
        tolerance: (B,) residual, relative to the right-hand side, both measured by the preconditioner.
    """

    def dot(a: Tensor, b: Tensor) -> Tensor:
        products = a * b
        return products.sum().reshape(1) if num_scenes == 1 else sum_per_scene(products.sum(1), scene, num_scenes)

    def spread(values: Tensor) -> Tensor:
        return values if num_scenes == 1 else values[scene].unsqueeze(1)

    def precondition(r: Tensor) -> Tensor:
        return torch.bmm(inverse, r.unsqueeze(2)).squeeze(2)

    x, r = torch.zeros_like(rhs), rhs.clone()
    z = precondition(r)
    p, rz = z, dot(r, z)
    limit = tolerance**2 * rz
    for iteration in range(max_iterations):
        active = rz > limit
        if not bool(active.any()):
            return x, iteration
        q = apply(p)
        curvature = dot(p, q)
        usable = active & (curvature > 0)
        length = torch.where(usable, rz / torch.where(usable, curvature, 1.0), 0.0)
        x = x + spread(length) * p
        r = r - spread(length) * q
        z = precondition(r)
        before, rz = rz, torch.where(usable, dot(r, z), torch.where(active, 0.0, rz))
        p = z + spread(torch.where(usable, rz / before, 0.0)) * p
    return x, max_iterations


def solve_direct(plan: SolverPlan, triples: Tensor, rhs: Tensor) -> Tensor:
    """Solution of H x = ``rhs`` (N, 3) by a band Cholesky factorisation, on the CPU.

    Raises:
        numpy.linalg.LinAlgError: H is not positive definite to rounding.
    """
    layout = band_layout(plan)
    size = 3 * plan.pattern.size
    values, right = triples.cpu().numpy().reshape(-1), rhs.cpu().numpy().reshape(-1)
    band = np.zeros((layout.num_below + 1) * size, dtype=values.dtype)
    band[layout.places] = values[layout.entries]
    storage = band.reshape(size, layout.num_below + 1).T  # column-major, as LAPACK wants it: no copy
    factor = linalg.cholesky_banded(storage, overwrite_ab=True, lower=True, check_finite=False)
    solution = np.empty_like(right)
    solution[layout.order] = linalg.cho_solve_banded((factor, True), right[layout.order], check_finite=False)
    return torch.as_tensor(solution).view(-1, 3).to(rhs.device)


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
    determinant = (r0 * c0).sum(1).clamp_min(torch.finfo(blocks.dtype).eps)
    return torch.stack([c0, c1, c2], dim=2) / determinant[:, None, None] * outer


def band_layout(plan: SolverPlan) -> BandLayout:
    """Storage of the direct solver, computed on first use."""
    if "band" not in plan.cache:
        pattern, axes = plan.pattern, np.arange(3)
        rank, num_below = pattern.band_order()
        row = np.broadcast_to((3 * rank[pattern.rows])[:, None, None] + axes[:, None], (len(pattern.rows), 3, 3)).reshape(-1)
        col = np.broadcast_to((3 * rank[pattern.cols])[:, None, None] + axes, (len(pattern.cols), 3, 3)).reshape(-1)
        entries = np.flatnonzero(row >= col)
        order = np.argsort((3 * rank[:, None] + axes).reshape(-1))
        plan.cache["band"] = BandLayout(order, entries, (row - col + col * (num_below + 1))[entries], num_below)
    layout = plan.cache["band"]
    assert isinstance(layout, BandLayout)
    return layout
