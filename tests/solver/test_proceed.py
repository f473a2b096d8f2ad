"""Whoever calls the solver may stop it between iterations; what was reached is kept."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import Progress
from hood.solver.vertex.gauss_seidel import sweep
from hood.testing import grid, make_problem

POTENTIAL = default_potential()


@pytest.fixture(scope="module")
def problem() -> StepProblem:
    pos, faces = grid(7, 5, 0.3)
    return make_problem(build_cloth(pos, faces, Material(), torch.arange(35).numpy() < 5, dtype=torch.float64))


def start(problem: StepProblem) -> Tensor:
    return problem.state.pos + 2e-3 * torch.sin(60 * problem.state.pos.flip(1))


class Asked:
    """Says no at the ``limit``-th question, and keeps what it was told."""

    def __init__(self, limit: int) -> None:
        self.limit, self.told, self.places = limit, [], []

    def __call__(self, progress: Progress, pos: Tensor) -> bool:
        self.told.append(progress)
        self.places.append(pos)
        return len(self.told) <= self.limit


def test_newton_stops_where_it_is_told(problem: StepProblem) -> None:
    asked, settings = Asked(2), NewtonSettings(1e-9)
    pos, report = minimize(POTENTIAL, problem, start(problem), settings, proceed=asked)
    assert report.iterations == 2
    assert report.reason == ("stopped",)
    assert not bool(report.converged)
    assert torch.equal(asked.places[-1], pos)
    assert torch.equal(asked.told[-1].phi, report.phi)
    counted, _ = minimize(POTENTIAL, problem, start(problem), NewtonSettings(1e-9, 2))
    assert torch.equal(pos, counted)
    whole, _ = minimize(POTENTIAL, problem, start(problem), settings, proceed=lambda progress, pos: True)
    assert torch.equal(whole, minimize(POTENTIAL, problem, start(problem), settings)[0])


def test_sweeps_stop_where_they_are_told(problem: StepProblem) -> None:
    for residuals in (True, False):
        asked = Asked(3)
        pos, report = sweep(POTENTIAL, problem, start(problem), 10, proceed=asked, residuals=residuals)
        assert report.kept.tolist() == [3]
        assert torch.equal(pos, sweep(POTENTIAL, problem, start(problem), 3)[0])
        assert len(report.history) == 4
        assert bool(torch.isfinite(report.history[-1].relative_gradient))
        assert all(bool(torch.isfinite(told.relative_gradient)) == residuals for told in asked.told)
        phi = torch.cat([progress.phi for progress in report.history])
        assert bool((phi.diff() < 0).all())


def test_sweeps_start_where_newton_starts(problem: StepProblem) -> None:
    none, _ = sweep(POTENTIAL, problem, None, 0)
    assert torch.equal(none, minimize(POTENTIAL, problem, settings=NewtonSettings(max_iterations=0))[0])
