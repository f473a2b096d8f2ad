"""The gap is zero at the minimum, known where the minimum is known, and flags references that did not converge."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.evaluation.gap import gap
from hood.solver.newton import NewtonSettings, minimize
from hood.testing import grid, make_problem


@pytest.fixture
def problem() -> StepProblem:
    pos, faces = grid(6, 6, 0.1)
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64)
    noise = torch.randn(pos.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return make_problem(cloth, vel=0.05 * noise)


def test_the_minimum_has_no_gap(problem: StepProblem) -> None:
    potential = default_potential()
    pos, _ = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-6))
    result = gap(potential, problem, pos)
    assert abs(float(result.gamma)) < 1e-6
    assert bool(result.converged.all())
    assert bool(result.agree.all())


def test_free_fall_is_known_exactly(problem: StepProblem) -> None:
    """Without elasticity Φ is quadratic: an acceleration error of 0.3 g everywhere has the gap 0.09."""
    whole = default_potential()
    potential = Potential({name: whole.terms[name] for name in ("inertia", "gravity")})
    dt = float(problem.step.dt[0])
    fall = problem.state.pos + dt * problem.state.vel + dt**2 * problem.gravity.to(problem.state.pos)
    wrong = fall + 0.3 * 9.81 * dt**2 * torch.tensor([1.0, 0.0, 0.0], dtype=fall.dtype)
    result = gap(potential, problem, wrong)
    assert math.isclose(float(result.gamma), 0.09, rel_tol=1e-6)


def test_an_unconverged_reference_is_flagged(problem: StepProblem) -> None:
    result = gap(default_potential(), problem, problem.state.pos, settings=NewtonSettings(target_rg=1e-12, max_iterations=1))
    assert not bool(result.converged.any())
    assert bool(torch.isnan(result.spread).all())
    assert float(result.gamma) >= 0


def test_a_converged_state_is_no_better_than_its_own_minimisation(problem: StepProblem) -> None:
    """Where the third start has nothing left to do, rounding must not flag the reference."""
    potential = default_potential()
    for seed in range(5):
        noise = torch.randn(problem.state.vel.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        step = replace(problem, state=replace(problem.state, vel=0.05 * noise))
        pos, report = minimize(potential, step, settings=NewtonSettings(target_rg=1e-10))
        assert bool(report.converged.all())
        result = gap(potential, step, pos)
        assert bool(result.converged.all())
        assert abs(float(result.gamma)) < 1e-6


def test_one_converged_start_agrees_with_nothing(problem: StepProblem) -> None:
    """Positions that converged before, and no iterations for the other starts."""
    potential = default_potential()
    pos, _ = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-6))
    result = gap(potential, problem, pos, settings=NewtonSettings(target_rg=1e-3, max_iterations=0))
    assert bool(result.converged.all())
    assert bool(torch.isnan(result.spread).all())
    assert not bool(result.agree.any())
