"""Newton directions with as much negative curvature as the linear system bears."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Attachments, StepInput, concatenate_states
from hood.energies.potential import default_potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import Unknowns
from hood.solver.system.linear import Directions
from hood.solver.system.plan import plan_for, quadratic_model
from hood.testing import cylinder, grid, make_problem

F64 = torch.float64
LINEAR = ("cg", "direct")


def squeezed(factor: float = 0.8, noise: float = 1e-3, pins: int = 0, dt: float = 1 / 30) -> StepProblem:
    """A sheet pressed together in its plane: its Hessian is indefinite."""
    pos, faces = grid(7, 6, 0.2)
    cloth = build_cloth(pos, faces, Material(), np.arange(42) < pins, dtype=F64)
    bumps = noise * torch.as_tensor(np.random.default_rng(0).normal(size=pos.shape))
    return make_problem(cloth, factor * cloth.rest_pos + bumps, dt=dt)


def together(problems: list[StepProblem]) -> StepProblem:
    return StepProblem(
        concatenate_cloths([p.cloth for p in problems]),
        concatenate_states([p.state for p in problems]),
        StepInput(dt=torch.cat([p.step.dt for p in problems])),
    )


def first_direction(problem: StepProblem, linear: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Direction and gradient at the problem's own positions."""
    now = Unknowns(default_potential(), problem).at(problem.state.pos)
    plan = plan_for(problem)
    model = quadratic_model(default_potential(), problem, plan, now.pos, now.acc)
    residual = relative_gradient(problem, model.gradient)
    find = Directions(plan, problem.num_scenes, linear, 1000)
    return find(model, residual, torch.ones_like(residual, dtype=torch.bool))[0], model.gradient


@pytest.mark.parametrize("linear", LINEAR)
@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0, 1.3])
def test_every_direction_descends(factor, linear):
    problem = squeezed(factor, pins=6)
    direction, gradient = first_direction(problem, linear)
    assert float((direction * gradient).sum()) < 0
    assert not direction[:6].any()


def test_conjugate_gradients_gain_what_the_newton_direction_does():
    problem = squeezed(1.1, noise=1e-4)
    gains = [float((direction * gradient).sum()) for direction, gradient in (first_direction(problem, name) for name in LINEAR)]
    assert gains[1] < 0
    assert 0.9 * gains[1] >= gains[0] >= 1.1 * gains[1]


@pytest.mark.parametrize("linear", LINEAR)
def test_an_indefinite_scene_does_not_change_its_neighbours(linear):
    problems = [squeezed(1.1, noise=1e-4), squeezed(0.7), squeezed(1.0, dt=1 / 60)]
    alone = [first_direction(problem, linear)[0] for problem in problems]
    found, _ = first_direction(together(problems), linear)
    torch.testing.assert_close(found, torch.cat(alone), rtol=0, atol=1e-9)


@pytest.mark.parametrize("linear", LINEAR)
def test_the_last_digits_come_fast(linear):
    """With the positive matrix alone each iteration under compression gains a constant factor."""
    problem = squeezed(0.97, noise=3e-3, pins=6)
    settings = NewtonSettings(target_rg=1e-9, max_iterations=40, linear=linear, cg_iterations=500)
    _, report = minimize(default_potential(), problem, settings=settings)
    assert report.converged.all(), report.reason
    residuals = [float(progress.relative_gradient) for progress in report.history]
    assert residuals[-1] < 0.05 * residuals[-2]


@pytest.mark.parametrize("linear", LINEAR)
def test_same_minimum_with_pins_fields_and_buttons(linear):
    """A sheet of uneven fabric, held and buttoned, beside a tube in the same scene."""
    rng = np.random.default_rng(3)
    pos, faces = grid(6, 6, 0.2)
    fabric = Material(bending_stiffness=1e-4, lame_mu=1e4 * (1 + rng.random(36)))
    cloths = [
        build_cloth(pos, faces, fabric, np.arange(36) < 6, dtype=F64),
        build_cloth(*cylinder(8, 5, 0.05, 0.1), Material(), dtype=F64),
    ]
    cloth = concatenate_cloths(cloths)
    cloth = replace(cloth, num_scenes=1, **{n: 0 * getattr(cloth, n) for n in vars(cloth) if n.endswith("_scene")})
    problem = make_problem(cloth)
    button = Attachments(torch.tensor([[35, 40], [30, 44]]), torch.tensor([True, False]))
    problem = replace(problem, step=replace(problem.step, attachments=button))
    settings = NewtonSettings(target_rg=1e-7, linear=linear, cg_iterations=500)
    found, report = minimize(default_potential(), problem, settings=settings)
    assert report.converged.all(), report.reason
    gradient, _ = default_potential().gradient(problem, found, report.acc)
    assert float(relative_gradient(problem, gradient)) <= 1e-7
