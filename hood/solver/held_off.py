"""Minima that are found again with cloth held farther off, where they leave it in the skin (:mod:`hood.scene.held_off`)."""

from __future__ import annotations

from torch import Tensor

from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.solver.newton import NewtonSettings, Report, minimize

#: So often is a step taken again that has led into skin which its contact did not show.
MOST_AGAIN = 3


def minimize_held_off(
    potential: Potential, problem: StepProblem, pos: Tensor, settings: NewtonSettings
) -> tuple[StepProblem, Tensor, list[Report]]:
    """The problem with cloth held off as far as it took, its minimum (V, 3) [m], and what was reached each time; the problem
    and ``pos`` themselves, and nothing, where these leave no more triangles in the skin than are allowed.

    Args:
        problem: prepared by ``potential``.
        pos: (V, 3) m, its minimum.
    """
    reports: list[Report] = []
    for _ in range(MOST_AGAIN):
        again = problem.with_held_off(pos)
        if again is problem:
            break
        problem = again
        pos, report = minimize(potential, problem, pos, settings)
        reports.append(report)
    return problem, pos, reports
