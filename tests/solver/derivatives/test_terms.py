"""The gathered form of a potential gives the potential's own numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Attachments, Obstacle, StepInput
from hood.contact.contact import find_contact
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential, reference_potential
from hood.energies.problem import StepProblem
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.system.plan import SolverPlan, plan_for, quadratic_model
from hood.testing import cylinder, grid, make_problem, sphere

F64 = torch.float64


def crumpled(dtype: torch.dtype = F64, scenes: int = 2) -> StepProblem:
    """A sheet with uneven fabric and a buttoned tube, part of both inside a ball: one scene or one each."""
    rng = np.random.default_rng(0)
    pos, faces = grid(6, 5, 0.2)
    fabric = Material(bending_stiffness=1e-3, density=0.1 + 0.2 * rng.random(30), lame_mu=1e4 * (1 + rng.random(30)))
    tube, tube_faces = cylinder(7, 4, 0.05, 0.1)
    cloths = [
        build_cloth(pos, faces, fabric, np.arange(30) < 5, dtype=dtype),
        build_cloth(tube, tube_faces, Material(), dtype=dtype),
    ]
    cloth = concatenate_cloths(cloths)
    if scenes == 1:
        cloth = replace(cloth, num_scenes=1, **{n: 0 * getattr(cloth, n) for n in vars(cloth) if n.endswith("_scene")})
    ball, triangles = sphere(2, 0.06)
    points, index = torch.as_tensor(ball).to(dtype), torch.as_tensor(triangles)
    scene = [torch.full((len(x),), s, dtype=torch.int64) for s in range(scenes) for x in (points, index)]
    body = Obstacle(
        torch.cat([points] * scenes),
        torch.cat([points + 0.001] * scenes),
        torch.cat([points] * scenes),
        torch.cat([index + s * len(points) for s in range(scenes)]),
        torch.cat(scene[0::2]),
        torch.cat(scene[1::2]),
    )
    start = cloth.rest_pos + 0.003 * torch.as_tensor(rng.normal(size=cloth.rest_pos.shape)).to(dtype)
    problem = make_problem(cloth, start, 0.05 * rng.normal(size=start.shape))
    button = Attachments(torch.tensor([[32, 50], [33, 51]]), torch.tensor([True, False]))
    step = StepInput(dt=start.new_tensor([1 / 30, 1 / 60][:scenes]), obstacle=body, attachments=button)
    return replace(problem, step=step, contact=find_contact(start, cloth.vertex_scene, body))


@pytest.mark.parametrize("make", [default_potential, reference_potential])
@pytest.mark.parametrize("scenes", [1, 2])
def test_energies_are_those_of_the_potential(make, scenes):
    potential = make()
    problem = potential.prepare(crumpled(scenes=scenes))
    pos = problem.state.pos + 2e-3 * torch.as_tensor(np.random.default_rng(1).normal(size=problem.state.pos.shape))
    acc = problem.acceleration(pos)
    expected = potential.energies(problem, pos, acc)
    assert min(float(expected[name].sum()) for name in ("collision", "friction", "attachment", "bending")) > 0
    found = sum(StepTerms(potential, problem).energies(pos, acc))
    torch.testing.assert_close(found, sum(expected.values()), rtol=1e-12, atol=1e-15)


def test_float32_keeps_the_forms_that_are_exact_there():
    """Contact far from the origin and inertia of tiny accelerations, to the rounding of their inputs."""
    potential = default_potential()
    problem = potential.prepare(crumpled(torch.float32))
    acc = torch.full_like(problem.state.pos, 1e-4)
    terms = StepTerms(potential, problem)
    inertia = terms.vertices.energies(problem.state.pos, acc, problem.vertex_dt)[0]
    exact = 0.5 * problem.cloth.mass.double() * (problem.vertex_dt.double().squeeze(1) * acc.double().norm(dim=1)) ** 2
    torch.testing.assert_close(inertia.double(), exact, rtol=1e-5, atol=0)


@pytest.mark.parametrize("make", [default_potential, reference_potential])
def test_gradient_is_that_of_the_potential(make):
    potential = make()
    problem = potential.prepare(crumpled())
    pos = problem.state.pos + 2e-3 * torch.as_tensor(np.random.default_rng(2).normal(size=problem.state.pos.shape))
    acc = problem.acceleration(pos)
    expected, _ = potential.gradient(problem, pos, acc)
    model = quadratic_model(potential, problem, plan_for(problem), pos, acc)
    torch.testing.assert_close(model.gradient, expected, rtol=1e-10, atol=1e-10 * float(expected.abs().max()))


def test_a_term_given_twice_counts_twice():
    problem = crumpled()
    once, twice = Potential({"a": Stretching()}), Potential({"a": Stretching(), "b": Stretching()})
    plan, pos = SolverPlan(problem.cloth, problem.step.attachments), problem.state.pos
    models = [quadratic_model(potential, problem, plan, pos, 0 * pos) for potential in (once, twice)]
    for name in ("gradient", "triples", "indefinite_part"):
        torch.testing.assert_close(getattr(models[1], name), 2 * getattr(models[0], name))
    torch.testing.assert_close(
        StepTerms(twice, problem).energies(pos, pos)[-1], 2 * StepTerms(once, problem).energies(pos, pos)[-1]
    )


def test_a_state_of_one_scene_does_not_reach_another():
    potential = default_potential()
    problem = potential.prepare(crumpled())
    moved = problem.state.pos.clone()
    moved[35] += 0.01
    before, after = (
        quadratic_model(potential, problem, plan_for(problem), pos, problem.acceleration(pos))
        for pos in (problem.state.pos, moved)
    )
    assert torch.equal(before.gradient[:30], after.gradient[:30])
    assert not torch.equal(before.gradient[30:], after.gradient[30:])
