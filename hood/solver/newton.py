"""The implicit step without a network: projected Newton on the incremental potential."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from hood.losses.potential import Potential, relative_gradient
from hood.losses.problem import StepProblem
from hood.solver import linear
from hood.solver.iterate import Iterate, Unknowns, in_double, projected_guess, rounded
from hood.solver.plan import QuadraticModel, SolverPlan, plan_for, quadratic_model

_ARMIJO = 1e-4
_BACKTRACKS = 40


@dataclass(frozen=True)
class NewtonSettings:
    """How far and how :func:`minimize` goes.

    Args:
        target_rg: relative gradient to reach, see :func:`hood.losses.potential.relative_gradient`.
        max_iterations: Newton iterations.
        budget_ms: stop after the iteration that passes this time [ms]; None for no limit.
        linear: ``cg`` (conjugate gradients, block-Jacobi) or ``direct`` (band Cholesky, on the CPU). Both are as fast at
            1,000 vertices; beyond, cg is faster unless a high accuracy is asked for.
        cg_iterations: at most as many per Newton iteration.
        double: compute in float64 whatever the problem's type. In float32 the potential of a garment is known to
            1e-7 of its value, which stops a line search early; the result comes back in the problem's type anyway.
    """

    target_rg: float = 1e-3
    max_iterations: int = 100
    budget_ms: float | None = None
    linear: str = "cg"
    cg_iterations: int = 50
    double: bool = True

    def __post_init__(self) -> None:
        if not self.target_rg > 0 or self.max_iterations < 0 or self.cg_iterations < 1:
            raise ValueError(
                f"solver: target_rg is {self.target_rg}, max_iterations {self.max_iterations}, cg_iterations "
                f"{self.cg_iterations}; give target_rg > 0, max_iterations >= 0 and cg_iterations >= 1"
            )
        if self.linear not in ("cg", "direct"):
            raise ValueError(f"solver: linear is {self.linear!r}; choose cg or direct")


@dataclass(frozen=True)
class Progress:
    """Where the solver stood before an iteration."""

    seconds: float
    phi: Tensor  # (B,) J
    relative_gradient: Tensor  # (B,)


@dataclass(frozen=True)
class Report:
    """What :func:`minimize` reached, scene by scene; float64 where it computed in float64."""

    iterations: int
    cg_iterations: int
    phi: Tensor  # (B,) J
    relative_gradient: Tensor  # (B,)
    converged: Tensor  # (B,) bool
    reason: tuple[str, ...]  # (B) "" or "max iterations", "time budget", "line search failed", "not finite"
    acc: Tensor  # (V, 3) m/s² that leads to the positions, without their cancellation in float32
    history: list[Progress] = field(default_factory=list)


@torch.no_grad()
def minimize(
    potential: Potential,
    problem: StepProblem,
    start: Tensor | None = None,
    settings: NewtonSettings | None = None,
    plan: SolverPlan | None = None,
) -> tuple[Tensor, Report]:
    """Positions (V, 3) at t + 1 that minimise ``potential``: one step of implicit Euler.

    Newton's method with the positive Hessian of :func:`hood.solver.plan.quadratic_model` and an Armijo line search per
    scene; the scenes of a batch do not touch each other. Pinned vertices are at their targets exactly, massless ones
    stay. The potential never rises beyond rounding; the minimum is a local one. A scene that is not finite at
    the start is left there and reported.

    Args:
        start: (V, 3) m, free vertices are taken from it; default :func:`hood.solver.iterate.projected_guess`.
        settings: default ``NewtonSettings()``.
        plan: of the problem's cloth; default from a cache.
    """
    settings = settings or NewtonSettings()
    work = in_double(problem) if settings.double else problem
    plan = plan or plan_for(work)
    if start is not None:
        start = start.detach().to(work.state.pos.dtype)
    pos, report = _Newton(potential, work, plan, settings).run(start)
    return rounded(problem, pos), replace(report, acc=report.acc.to(problem.state.pos.dtype))


class _Newton:
    def __init__(self, potential: Potential, problem: StepProblem, plan: SolverPlan, settings: NewtonSettings) -> None:
        self.potential, self.problem, self.plan, self.settings = potential, problem, plan, settings
        self.unknowns = Unknowns(potential, problem)
        self.direct = settings.linear == "direct"

    def run(self, start: Tensor | None) -> tuple[Tensor, Report]:
        began = time.perf_counter()
        settings, problem = self.settings, self.problem
        now = self.unknowns.at(projected_guess(self.potential, problem) if start is None else start)
        active = torch.isfinite(now.phi)
        finite, stuck, late = active, ~active, False
        history: list[Progress] = []
        iteration = cg_iterations = 0
        while True:
            model = quadratic_model(self.potential, problem, self.plan, now.pos, now.acc)
            residual = relative_gradient(problem, model.gradient)
            finite = finite & torch.isfinite(residual)
            active = finite & ~stuck & (residual > settings.target_rg)
            history.append(Progress(time.perf_counter() - began, now.phi, residual))
            late = settings.budget_ms is not None and 1e3 * history[-1].seconds > settings.budget_ms
            if late or iteration >= settings.max_iterations or not bool(active.any()):
                break
            direction, used = self._direction(model, residual, active)
            now, moved = self._search(now, model, direction, active)
            stuck = stuck | (active & ~moved)
            iteration, cg_iterations = iteration + 1, cg_iterations + used
        converged = finite & (residual <= settings.target_rg)
        reason = _reasons(converged, finite, stuck, "time budget" if late else "max iterations")
        return now.pos, Report(iteration, cg_iterations, now.phi, residual, converged, reason, now.acc, history)

    def _direction(self, model: QuadraticModel, residual: Tensor, active: Tensor) -> tuple[Tensor, int]:
        """Newton direction (V, 3), zero where nothing moves, and the conjugate gradient iterations it took."""
        plan = self.plan
        moving = active[plan.scene].unsqueeze(1)
        rhs = torch.where(moving, -model.gradient[plan.vertices], 0.0)
        triples = self._without_broken_scenes(model.triples, active)
        if self.direct:
            solution, used = self._solve_direct(triples, rhs), 0
        else:
            solution, used = linear.conjugate_gradients(
                linear.product(plan.pattern, triples),
                linear.diagonal_inverse(plan.pattern, triples),
                rhs,
                plan.scene,
                self.problem.num_scenes,
                residual.nan_to_num(0.0).sqrt().clamp(1e-3, 0.1),
                self.settings.cg_iterations,
            )
        direction = torch.zeros_like(model.gradient)
        direction[plan.vertices] = torch.where(moving, solution, 0.0)
        return direction, used

    def _without_broken_scenes(self, triples: Tensor, active: Tensor) -> Tensor:
        """Identity blocks for scenes that do not move: theirs may not be finite and would spoil a factorisation."""
        if bool(active.all()):
            return triples
        pattern = self.plan.pattern
        rows = torch.as_tensor(pattern.rows, device=triples.device).repeat_interleave(3)
        kept = torch.where(active[self.plan.scene][rows].unsqueeze(1), triples, 0.0)
        idle = ~active[self.plan.scene]
        diagonal = pattern.diagonal.to(triples.device)[idle]
        kept[diagonal.reshape(-1)] = torch.eye(3, dtype=kept.dtype, device=kept.device).repeat(int(idle.sum()), 1)
        return kept

    def _solve_direct(self, triples: Tensor, rhs: Tensor) -> Tensor:
        try:
            return linear.solve_direct(self.plan, triples, rhs)
        except np.linalg.LinAlgError:
            # Positive definite by construction: only rounding (stiffness ratios beyond the type) brings us here.
            inverse = linear.diagonal_inverse(self.plan.pattern, triples)
            return torch.bmm(inverse, rhs.unsqueeze(2)).squeeze(2)

    def _search(self, now: Iterate, model: QuadraticModel, direction: Tensor, active: Tensor) -> tuple[Iterate, Tensor]:
        """Backtracking per scene: the next iterate, and the scenes (B,) that moved."""
        unknowns = self.unknowns
        slope = self.problem.sum_vertices((model.gradient * direction).sum(1))
        step = direction / unknowns.dt_sq
        length = torch.ones_like(slope)
        searching, moved, result = active & (slope < 0), torch.zeros_like(active), now
        for _ in range(_BACKTRACKS):
            if not bool(searching.any()):
                break
            trial = unknowns.evaluate(now.acc + (length * searching)[unknowns.scene].unsqueeze(1) * step)
            accepted = searching & (trial.phi <= now.phi + _ARMIJO * length * slope + now.noise)
            result = unknowns.select(accepted, trial, result)
            moved, searching = moved | accepted, searching & ~accepted
            length = torch.where(searching, _shorter(length, slope, trial.phi - now.phi), length)
        return result, moved


def _shorter(length: Tensor, slope: Tensor, rise: Tensor) -> Tensor:
    """Step length (B,) at the minimum of the parabola through what is known, between a tenth and a half of the last."""
    excess = rise - length * slope
    usable = torch.isfinite(excess) & (excess > 0)
    parabola = torch.where(usable, -0.5 * slope * length**2 / torch.where(usable, excess, 1.0), 0.1 * length)
    return torch.minimum(torch.maximum(parabola, 0.1 * length), 0.5 * length)


def _reasons(converged: Tensor, finite: Tensor, stuck: Tensor, otherwise: str) -> tuple[str, ...]:
    reasons = []
    for done, sound, halted in zip(converged.tolist(), finite.tolist(), stuck.tolist(), strict=True):
        reasons.append("" if done else "not finite" if not sound else "line search failed" if halted else otherwise)
    return tuple(reasons)
