"""Coloured local descent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Attachments, State, StepInput
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.potential import default_potential, relative_gradient, scale
from hood.energies.wind import Wind
from hood.solver.derivatives.step_terms import StepTerms
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.vertex.gauss_seidel import colours_of, greedy_colours, neighbourhoods, sweep, vertex_systems
from hood.testing import concatenate_contacts, cylinder, grid, make_problem, plane_contact

F64 = torch.float64


def sheet(dtype=F64, stiffness=1.0, pins=5, attached=False):
    pos, faces = grid(7, 5, 0.3)
    material = Material(lame_mu=23600.0 * stiffness, lame_lambda=44400.0 * stiffness, bending_stiffness=1e-4)
    cloth = build_cloth(pos, faces, material, np.arange(35) < pins, dtype=dtype)
    problem = make_problem(cloth, contact=plane_contact(cloth.rest_pos, height=-0.004))
    if attached:
        button = Attachments(torch.tensor([[20, 34], [9, 28]]), torch.tensor([True, False]))
        problem = replace(problem, step=replace(problem.step, attachments=button))
    return problem


def noisy(pos, size=1e-3, seed=0):
    return pos + size * torch.as_tensor(np.random.default_rng(seed).normal(size=pos.shape)).to(pos)


def test_colours_share_no_element():
    problem = sheet(attached=True)
    plan = plan_for(problem)
    colour = greedy_colours(plan.pattern)
    rows, cols = plan.pattern.rows, plan.pattern.cols
    assert (colour[rows] != colour[cols])[rows != cols].all()
    assert colour.max() < 12
    groups = colours_of(plan, problem.cloth, problem.step.attachments)
    assert sorted(torch.cat([group.vertices for group in groups]).tolist()) == plan.vertices.tolist()


def test_one_colour_of_one_vertex_is_an_exact_block_step():
    """A single free vertex: its system is the whole Hessian, so a sweep is a Newton step."""
    pos, faces = grid(3, 3, 0.1)
    cloth = build_cloth(pos, faces, Material(), np.arange(9) != 4, dtype=F64)
    problem = make_problem(cloth)
    start = problem.state.pos + torch.tensor([0.0, -0.003, 0.0]) * problem.cloth.free.unsqueeze(1)
    plan = plan_for(problem)
    model = quadratic_model(default_potential(), problem, plan, start, problem.acceleration(start))
    step = -torch.linalg.solve(model.triples, model.gradient[4])
    found, report = sweep(default_potential(), problem, start, 1)
    torch.testing.assert_close(found[4], start[4] + step, rtol=0, atol=1e-12)
    assert report.kept.tolist() == [1]


@pytest.mark.parametrize("stiffness", [1.0, 100.0])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_potential_never_rises(dtype, stiffness):
    potential, problem = default_potential(), sheet(dtype, stiffness, attached=True)
    for seed, size in enumerate((1e-4, 3e-3, 3e-2)):
        pos = noisy(problem.state.pos, size, seed)
        before = sweep(potential, problem, pos, 0)[1].phi
        for _ in range(4):
            pos, report = sweep(potential, problem, pos, 1, double=dtype == F64)
            assert torch.isfinite(pos).all()
            assert float(report.phi) <= float(before) * (1 + 1e-5 * (dtype != F64))
            before = report.phi


def test_vertex_noise_is_gone_after_few_sweeps():
    potential, problem = default_potential(), sheet(attached=True)
    exact, best = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-7))
    start = torch.where(problem.cloth.free.unsqueeze(1), noisy(exact, 3e-4), exact)
    before = sweep(potential, problem, start, 0)[1]
    found, report = sweep(potential, problem, start, 10)
    assert int(report.kept) == 10
    gap = ((report.phi - best.phi) / scale(problem)).item()
    assert gap < 0.02 * float((before.phi - best.phi) / scale(problem))
    gradient, _ = potential.gradient(problem, found, report.acc)
    torch.testing.assert_close(report.relative_gradient, relative_gradient(problem, gradient))
    assert torch.equal(found[:5], problem.state.pos[:5])


def test_a_minimum_stays():
    potential, problem = default_potential(), sheet()
    exact, best = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-9))
    found, report = sweep(potential, problem, exact, 3)
    torch.testing.assert_close(found, exact, rtol=0, atol=1e-9)
    assert float(report.phi) <= float(best.phi)


def test_batch_equals_singles():
    potential = default_potential()
    tube = build_cloth(*cylinder(6, 4, 0.1, 0.2), Material(), dtype=F64)
    problems = [sheet(pins=0), make_problem(tube, dt=1 / 60, contact=plane_contact(tube.rest_pos))]
    contact = concatenate_contacts([p.contact for p in problems])
    together = replace(
        problems[0],
        cloth=concatenate_cloths([p.cloth for p in problems]),
        state=State(*(torch.cat([getattr(p.state, name) for p in problems]) for name in ("pos", "vel", "origin"))),
        step=StepInput(dt=torch.cat([p.step.dt for p in problems])),
        contact=contact,
    )
    starts = [noisy(p.state.pos, 2e-3, seed) for seed, p in enumerate(problems)]
    found, report = sweep(potential, together, torch.cat(starts), 3)
    # Another numbering of colours visits vertices in another order: equal quality, not equal numbers.
    alone = [sweep(potential, p, start, 3) for p, start in zip(problems, starts, strict=True)]
    for scene, (_, single) in enumerate(alone):
        assert float(report.phi[scene]) == pytest.approx(float(single.phi), rel=0.2)
    assert torch.isfinite(found).all()


def test_a_scene_that_is_not_finite_is_left_alone():
    problem = sheet()
    start = problem.state.pos.clone()
    start[10] = float("nan")
    found, report = sweep(default_potential(), problem, start, 3)
    assert report.kept.tolist() == [0]
    torch.testing.assert_close(found, start, equal_nan=True)


def test_negative_count_is_refused():
    problem = sheet()
    with pytest.raises(ValueError, match="0 or more"):
        sweep(default_potential(), problem, problem.state.pos, -1)


@pytest.mark.parametrize("blown", [False, True])
def test_vertex_systems_are_the_diagonal_of_the_model(blown):
    potential, problem = default_potential(), sheet(attached=True)
    if blown:
        damping = {"stretch_damping": StretchDamping(0.02), "bend_damping": BendDamping(0.03)}
        potential = potential.with_terms(wind=Wind([3.0, 1.0, -2.0]), **damping)
        problem = replace(problem, state=replace(problem.state, pos=noisy(problem.state.pos, 2e-3, seed=5)))
    pos = noisy(problem.state.pos, 3e-3)
    acc, plan = problem.acceleration(pos), plan_for(problem)
    model = quadratic_model(potential, problem, plan, pos, acc)
    place = {vertex: row for row, vertex in enumerate(plan.vertices.tolist())}
    terms = StepTerms(potential, problem)
    for group in neighbourhoods(terms):
        colour = group.colour
        gradient, matrix = vertex_systems(terms, group, pos, acc)
        torch.testing.assert_close(gradient, model.gradient[colour.vertices], rtol=1e-10, atol=1e-12)
        rows = [place[vertex] for vertex in colour.vertices.tolist()]
        blocks = model.triples[plan.pattern.diagonal[rows].reshape(-1)].view(-1, 3, 3)
        torch.testing.assert_close(matrix, blocks, rtol=1e-10, atol=1e-10)
