"""Springs that hold vertices to places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import StepInput, concatenate_step_inputs
from hood.energies.mass_points import Gravity, Inertia, SoftPins
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex.block_jacobi import LocalTerms
from hood.testing import grid, make_problem

F64 = torch.float64


def hung(stiffness: torch.Tensor | None = None, dt: float = 1 / 30, pinned: np.ndarray | None = None) -> StepProblem:
    """A sheet with springs [N/m] (12,) to where it is at rest; seven random ones where none are given."""
    cloth = build_cloth(*grid(4, 3, 0.3), Material(), pinned=pinned, dtype=F64)
    problem = make_problem(cloth, cloth.rest_pos + 0.01 * torch.randn(12, 3, dtype=F64), dt=dt)
    if stiffness is None:
        stiffness = torch.where(torch.arange(12) < 7, 5.0 + 20.0 * torch.rand(12, dtype=F64), 0.0)
    step = replace(problem.step, pin_target=cloth.rest_pos.clone(), pin_stiffness=stiffness)
    return replace(problem, step=step)


def test_the_closed_form_is_that_of_autograd_and_its_matrices_are_the_hessian() -> None:
    problem = hung()
    potential = Potential({"soft_pins": SoftPins(), "inertia": Inertia(), "stretching": Stretching()})
    pos = problem.state.pos
    form = SoftPins().closed_form(problem)
    gradient, matrix = form.derivatives(pos)
    torch.testing.assert_close(gradient, Potential({"soft_pins": SoftPins()}).gradient(problem, pos)[0], rtol=1e-12, atol=1e-14)
    exact = torch.autograd.functional.hessian(lambda x: form.energy(x).sum(), pos).reshape(36, 36)
    torch.testing.assert_close(torch.block_diag(*matrix), exact, rtol=1e-12, atol=1e-12)
    step = 1e-6 * torch.randn(12, 3, dtype=F64)
    change = form.energy(pos + step) - form.energy(pos - step)
    assert float(change) == pytest.approx(2.0 * float((gradient * step).sum()), rel=1e-6)
    # the solvers
    acc = problem.acceleration(pos)
    expected, energies = potential.gradient(problem, pos)
    torch.testing.assert_close(quadratic_model(potential, problem, plan_for(problem), pos, acc).gradient, expected)
    torch.testing.assert_close(sum(StepTerms(potential, problem).energies(pos, acc)), sum(energies.values()))
    torch.testing.assert_close(-LocalTerms(potential, problem)(pos).force, expected)


def test_what_is_held_exactly_has_no_spring_and_a_step_without_springs_no_energy() -> None:
    problem, free = hung(pinned=np.arange(12) < 3), hung(torch.zeros(12, dtype=F64))
    assert bool((SoftPins().closed_form(problem).stiffness[:3] == 0).all())
    assert float(SoftPins()(free, free.state.pos, free.state.pos)) == 0.0
    assert not SoftPins().applies(make_problem(problem.cloth))


@pytest.mark.parametrize("sag", [1e-3, 0.02])
def test_each_vertex_hangs_by_its_weight_over_its_stiffness(sag: float) -> None:
    """Springs in proportion to the masses: no edge is strained, and all sink by m g / k."""
    problem = hung(torch.zeros(12, dtype=F64), dt=1e3)
    gravity = float(problem.gravity.norm())
    stiffness = problem.cloth.mass * gravity / sag
    problem = replace(problem, step=replace(problem.step, pin_stiffness=stiffness))
    potential = Potential({"soft_pins": SoftPins(), "inertia": Inertia(), "gravity": Gravity(), "stretching": Stretching()})
    pos, report = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-9))
    assert bool(report.converged.all())
    torch.testing.assert_close(pos, problem.cloth.rest_pos + sag * problem.gravity / gravity, rtol=0, atol=1e-7)


@pytest.mark.parametrize("engine", ["torch", "compiled"])
def test_springs_hold_the_weight_of_the_whole_cloth(engine: str) -> None:
    problem = hung(dt=1e3)
    potential = default_potential().with_terms(soft_pins=SoftPins())
    pos, _ = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-8, engine=engine))
    pull = problem.step.pin_stiffness[:, None] * (problem.step.pin_target - pos)
    weight = problem.cloth.mass.sum() * problem.gravity
    torch.testing.assert_close(-pull.sum(dim=0), weight, rtol=0, atol=1e-5 * float(weight.norm()))


def test_in_a_batch_each_scene_has_its_own() -> None:
    step, none = hung().step, StepInput(torch.tensor([0.1], dtype=F64))
    both = concatenate_step_inputs([none, step], [5, 12])
    assert both.pin_stiffness.tolist() == [0.0] * 5 + step.pin_stiffness.tolist()
    assert torch.equal(both.pin_target[5:], step.pin_target)
    assert concatenate_step_inputs([none, none], [5, 5]).pin_stiffness is None
