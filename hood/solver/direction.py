"""Newton directions: as much of the Hessian's negative curvature as the linear system bears."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from hood.solver import linear
from hood.solver.layers import LayerRows
from hood.solver.plan import QuadraticModel, SolverPlan

#: Below this share of the slack the next try does without.
LEAST_SHARPNESS = 0.2
#: The first share that is tried.
FIRST_SHARPNESS = 0.1


class Directions:
    """Solves the Newton systems of a minimisation, scene by scene.

    The positive matrix of :class:`hood.solver.plan.QuadraticModel` is larger than the Hessian under compression and along
    sliding contacts: with it alone the last digits come linearly, by a factor of about 2 an iteration. So a share of the
    slack is added, the *sharpness*: none at first, where the model is farthest from the energy, then a tenth, twice as much
    with every system solved, half as much wherever the linear solver meets negative curvature, none below 0.2. Over 96 steps
    of worn garments of 1,000 and 4,400 vertices this needs 4 and 4.5 iterations to γ = 0.01 in the median; to begin with all
    of the slack took 5 and 6. The idea to convexify only where that turns out necessary is that of Fernández-Fernández et
    al. ("Progressively Projected Newton's Method", 2025), who decide element by element.
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
        sharpness = torch.zeros_like(residual) if self._sharpness is None else self._sharpness
        moving = active[plan.scene].unsqueeze(1)
        rhs = torch.where(moving, -model.gradient[plan.vertices], 0.0)
        inverse = linear.diagonal_inverse(plan.pattern, self._idle(model.triples, active))
        solution, pending, halved = torch.zeros_like(rhs), active, torch.zeros_like(active)
        while True:
            triples = self._idle(self._sharpened(model, sharpness), pending)
            right = torch.where(pending[plan.scene].unsqueeze(1), rhs, 0.0)
            found, failed = self._solve(triples, inverse, right, residual, model.layers)
            failed = failed & pending & (sharpness > 0)
            solution = torch.where((pending & ~failed)[plan.scene].unsqueeze(1), found, solution)
            if not bool(failed.any()):
                break
            pending, halved = failed, halved | failed
            smaller = torch.where(sharpness > LEAST_SHARPNESS, 0.5 * sharpness, 0.0)
            sharpness = torch.where(failed, smaller, sharpness)
        raised = (2.0 * sharpness).clamp(FIRST_SHARPNESS, 1.0)
        self._sharpness = torch.where(halved, sharpness, raised)
        direction = torch.zeros_like(model.gradient)
        direction[plan.vertices] = torch.where(moving, solution, 0.0)
        return direction, inverse

    def _solve(
        self, triples: Tensor, inverse: Tensor, rhs: Tensor, residual: Tensor, layers: LayerRows | None
    ) -> tuple[Tensor, Tensor]:
        """Solution (N, 3), and the scenes (B,) bool in which the matrix is not positive definite as far as was seen."""
        if self.linear == "direct" and layers is None:  # a factorisation knows the pattern alone
            return self._solve_direct(triples, inverse, rhs)
        solution, used, failed = linear.conjugate_gradients(
            _beside(linear.product(self.plan.pattern, triples), layers),
            linear.by_blocks(inverse),
            rhs,
            self.plan.scene,
            self.num_scenes,
            residual.nan_to_num(0.0).sqrt().clamp(1e-3, 0.1),
            self.cg_iterations,
        )
        self.used += used
        return solution, failed

    def _solve_direct(self, triples: Tensor, inverse: Tensor, rhs: Tensor) -> tuple[Tensor, Tensor]:
        failed = torch.zeros(self.num_scenes, dtype=torch.bool, device=rhs.device)
        while True:
            solution, row = linear.solve_direct(self.plan, triples, rhs)
            if row is None:
                break
            failed[self.plan.scene[row]] = True
            triples = self._idle(triples, ~failed)
        # A descent direction where not even the positive matrix is one to rounding: stiffness ratios beyond the type.
        return torch.where(failed[self.plan.scene].unsqueeze(1), linear.by_blocks(inverse)(rhs), solution), failed

    def _sharpened(self, model: QuadraticModel, sharpness: Tensor) -> Tensor:
        if self.num_scenes == 1:
            share = float(sharpness)
            return torch.add(model.triples, model.slack, alpha=share) if share > 0 else model.triples
        return torch.addcmul(model.triples, model.slack, sharpness[self._triple_scene()].unsqueeze(1))

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


def _beside(apply: Callable[[Tensor], Tensor], layers: LayerRows | None) -> Callable[[Tensor], Tensor]:
    """``apply`` with what layers add beside the pattern."""
    return apply if layers is None else lambda x: apply(x) + layers.couple(x)
