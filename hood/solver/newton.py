"""The implicit step without a network: projected Newton on the incremental potential."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from hood.losses.potential import Potential, relative_gradient
from hood.losses.problem import StepProblem
from hood.solver.direction import Directions
from hood.solver.iterate import Iterate, Proceed, Progress, Unknowns, first_iterate, in_double, rounded
from hood.solver.plan import ModelBuilder, QuadraticModel, SolverPlan, plan_for
from hood.solver.reasons import CONVERGED, LATE, MOST_ITERATIONS, NOT_FINITE, STOPPED, STUCK
from hood.solver.search import Path, backtrack


@dataclass(frozen=True)
class NewtonSettings:
    """How far and how :func:`minimize` goes.

    Args:
        target_rg: relative gradient to reach, see :func:`hood.losses.potential.relative_gradient`.
        max_iterations: Newton iterations.
        budget_ms: stop after the iteration that passes this time [ms]; None for no limit.
        linear: ``cg`` (conjugate gradients, block-Jacobi) or ``direct`` (band Cholesky, on the CPU). A Newton
            iteration with the latter takes twice the time at 1,000 vertices and three times at 4,000, for a tenth fewer.
        cg_iterations: at most as many per Newton iteration.
        double: compute in float64 whatever the problem's type. In float32 the potential of a garment is known to
            1e-7 of its value, which stops a line search early; the result comes back in the problem's type anyway.
    """

    target_rg: float = 1e-3
    max_iterations: int = 100
    budget_ms: float | None = None
    linear: str = "cg"
    cg_iterations: int = 100
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
class Report:
    """What :func:`minimize` reached, scene by scene; float64 where it computed in float64."""

    iterations: int
    cg_iterations: int
    phi: Tensor  # (B,) J
    relative_gradient: Tensor  # (B,)
    converged: Tensor  # (B,) bool
    reason: tuple[str, ...]  # (B) of :mod:`hood.solver.reasons`
    acc: Tensor  # (V, 3) m/s² that leads to the positions, without their cancellation in float32
    history: list[Progress] = field(default_factory=list)


@torch.no_grad()
def minimize(
    potential: Potential,
    problem: StepProblem,
    start: Tensor | None = None,
    settings: NewtonSettings | None = None,
    plan: SolverPlan | None = None,
    proceed: Proceed | None = None,
) -> tuple[Tensor, Report]:
    """Positions (V, 3) at t + 1 that minimise ``potential``: one step of implicit Euler.

    Newton's method with as much of the Hessian as is positive definite (:class:`hood.solver.direction.Directions`) and an
    Armijo line search along paths that respect contact (:class:`hood.solver.search.Path`), both scene by scene; the scenes
    of a batch do not touch each other. Pinned vertices are at their targets exactly, massless ones
    stay. The potential never rises beyond rounding; the minimum is a local one. A scene that is not finite at
    the start is left there and reported.

    Args:
        start: (V, 3) m, free vertices are taken from it; default :func:`hood.solver.iterate.first_iterate`.
        settings: default ``NewtonSettings()``.
        plan: of the problem's cloth; default from a cache.
        proceed: asked before every iteration but the one that nothing is left for; default always.
    """
    began = time.perf_counter()
    settings = settings or NewtonSettings()
    problem = potential.prepare(problem)
    work = in_double(problem) if settings.double else problem
    plan = plan or plan_for(work)
    if start is not None:
        start = start.detach().to(work.state.pos.dtype)
    pos, report = _Newton(potential, work, plan, settings).run(start, began, proceed)
    return rounded(problem, pos), replace(report, acc=report.acc.to(problem.state.pos.dtype))


class _Newton:
    def __init__(self, potential: Potential, problem: StepProblem, plan: SolverPlan, settings: NewtonSettings) -> None:
        self.problem, self.plan, self.settings = problem, plan, settings
        self.unknowns = Unknowns(potential, problem)
        self.directions = Directions(plan, problem.num_scenes, settings.linear, settings.cg_iterations)

    def run(self, start: Tensor | None, began: float, proceed: Proceed | None) -> tuple[Tensor, Report]:
        settings, problem = self.settings, self.problem
        build = ModelBuilder(self.unknowns.terms, self.plan)
        now = first_iterate(self.unknowns) if start is None else self.unknowns.at(start)
        active = torch.isfinite(now.phi)
        finite, stuck, late, why = active, ~active, False, MOST_ITERATIONS
        history: list[Progress] = []
        iteration = 0
        while True:
            model = build(now.pos, now.acc)
            residual = relative_gradient(problem, model.gradient)
            finite = finite & torch.isfinite(residual)
            active = finite & ~stuck & (residual > settings.target_rg)
            history.append(Progress(time.perf_counter() - began, now.phi, residual))
            late = settings.budget_ms is not None and 1e3 * history[-1].seconds > settings.budget_ms
            if late or iteration >= settings.max_iterations or not bool(active.any()):
                why = LATE if late else why
                break
            if proceed is not None and not proceed(history[-1], now.pos):
                why = STOPPED
                break
            now, moved = self._step(now, model, residual, active)
            stuck = stuck | (active & ~moved)
            iteration += 1
        converged = finite & (residual <= settings.target_rg)
        reason = _reasons(converged, finite, stuck, why)
        return now.pos, Report(iteration, self.directions.used, now.phi, residual, converged, reason, now.acc, history)

    def _step(self, now: Iterate, model: QuadraticModel, residual: Tensor, active: Tensor) -> tuple[Iterate, Tensor]:
        """The next iterate, and the scenes (B,) that moved."""
        direction, inverse = self.directions(model, residual, active)
        slope = self.problem.sum_vertices((model.gradient * direction).sum(1))
        path = Path(self.unknowns, now, direction, inverse, self.plan.vertices)
        return backtrack(self.unknowns, path, now, slope, active)


def _reasons(converged: Tensor, finite: Tensor, stuck: Tensor, otherwise: str) -> tuple[str, ...]:
    reasons = []
    for done, sound, halted in zip(converged.tolist(), finite.tolist(), stuck.tolist(), strict=True):
        reasons.append(CONVERGED if done else NOT_FINITE if not sound else STUCK if halted else otherwise)
    return tuple(reasons)
